from crkr.dashboard.facts import worker_rows
from crkr.dashboard.progress import Progress


def test_workers_are_in_the_state_that_the_server_names_the_living_first() -> None:
    words = {"a": "left", "b": "lost", "c": "unannounced", "d": "alive", "e": 3, "f": None}
    status = {"workers": [{"id": name, "state": word} for name, word in words.items()]}
    assert [(row.name, row.state) for row in worker_rows(status, Progress())] == [
        ("d", "alive"),
        ("a", "left"),
        ("b", "lost"),
        ("c", "unannounced"),
        ("e", "unknown"),
        ("f", "unknown"),
    ]
