"""Which silent workers hang, by a clock that the test sets."""

from hypothesis import given
from hypothesis import strategies as st

from crkr.sim_worker.supervisor.stall import StallWatch


class Clock:
    """Moves only when the test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def silent(steps: list[tuple[float, str]], limit_s: float = 5.0) -> list[bool]:
    """Whether one worker was found hanging at each look; a step is the time that passes and what is known then."""
    clock, found = Clock(), []
    watch = StallWatch[str](limit_s, clock)
    watch.heard("worker")
    watch.look(["worker"], (), 0.0)
    for seconds, what in steps:
        clock.now += seconds
        if what == "heard":
            watch.heard("worker")
        owing = [] if what == "idle" else ["worker"]
        found.append("worker" in watch.look(owing, ["worker"] if what == "waits" else (), 3.0))
    return found


def test_a_worker_with_work_hangs_after_the_limit() -> None:
    assert silent([(1.0, "")] * 6) == [False] * 5 + [True]


def test_a_word_begins_a_new_account() -> None:
    assert silent([*[(1.0, "")] * 4, (1.0, "heard"), *[(1.0, "")] * 5]) == [False] * 10


def test_a_worker_without_work_may_be_silent() -> None:
    assert silent([(1.0, "idle")] * 20) == [False] * 20
    assert silent([*[(1.0, "idle")] * 20, *[(1.0, "")] * 5]) == [False] * 25


def test_a_worker_that_waits_for_the_server_has_more_time() -> None:
    assert silent([(1.0, "waits")] * 9) == [False] * 8 + [True]


def test_time_between_two_distant_looks_counts_for_little() -> None:
    assert silent([(1.0, ""), (3600.0, ""), (1.0, ""), (1.0, "")]) == [False] * 4


def test_before_the_first_word_there_is_time_to_start() -> None:
    clock = Clock()
    watch = StallWatch[str](5.0, clock)
    found = []
    for _ in range(52):
        found.append(bool(watch.look(["worker"], (), 0.0)))
        clock.now += 1.0
    assert found == [False] * 51 + [True]


@given(st.lists(st.tuples(st.floats(0.0, 1.9), st.sampled_from(["heard", "idle", "", "waits"])), max_size=60))
def test_a_worker_that_was_heard_or_had_no_work_within_the_limit_does_not_hang(steps: list[tuple[float, str]]) -> None:
    quiet = 0.0
    for (seconds, what), found in zip(steps, silent(steps), strict=True):
        quiet = 0.0 if what in ("heard", "idle") else quiet + seconds
        assert not found or quiet > 5.0
