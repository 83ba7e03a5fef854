from crkr.dashboard.progress import Progress
from crkr.dashboard.status_facts import worker_rows


def test_workers_are_in_the_state_that_the_server_names_the_living_first() -> None:
    words = {"a": "left", "b": "lost", "c": "unannounced", "d": "alive", "e": 3, "f": None}
    status = {"workers": [{"id": name, "state": word} for name, word in words.items()]}
    assert [(row.name, row.state) for row in worker_rows(status, Progress(), 0.0)] == [
        ("d", "alive"),
        ("a", "left"),
        ("b", "lost"),
        ("c", "unannounced"),
        ("e", "unknown"),
        ("f", "unknown"),
    ]


def test_a_workers_silence_is_the_servers_measurement_plus_the_time_since() -> None:
    """The time of day at the server, `last_seen`, may be years off."""
    told: dict[str, dict[str, object]] = {
        "a": {"last_seen_s": 2.0, "last_seen": 0.0},
        "b": {"last_seen": 0.0},
        "c": {"last_seen_s": "odd"},
    }
    status = {"workers": [{"id": name, "state": "alive"} | fields for name, fields in told.items()]}
    assert [row.quiet_s for row in worker_rows(status, Progress(), 1.5)] == [3.5, None, None]
