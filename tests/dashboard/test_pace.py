import pytest

from crkr.dashboard.progress import MOST_TIMES, PACE_S, Pace
from crkr.dashboard.status_facts import WorkerFacts, recent_workers, server_time


def paced(count: int, every_s: float) -> tuple[Pace, float]:
    """A pace and the time of its newest trial."""
    pace = Pace()
    for seq in range(1, count + 1):
        pace.add(1000.0 + every_s * seq)
    return pace, 1000.0 + every_s * count


@pytest.mark.parametrize("every_s", [0.001, 0.01, 0.1, 2.0])
def test_a_rate_is_right_for_a_display_that_joins_late(every_s: float) -> None:
    pace, last = paced(3 * MOST_TIMES, every_s)
    assert pace.rate(last) == pytest.approx(1 / every_s, rel=0.05)


def test_a_rate_falls_to_nothing_after_the_end() -> None:
    pace, last = paced(2000, 0.1)
    assert pace.rate(last + PACE_S / 2) == pytest.approx(5.0, rel=0.05)
    assert pace.rate(last + PACE_S) == 0.0


def test_a_rate_is_right_a_moment_after_the_beginning() -> None:
    pace, last = paced(50, 0.1)
    assert pace.rate(last) == pytest.approx(10.0, rel=0.05)
    assert Pace().rate(last) == 0.0


def test_the_servers_clock_counts_and_not_this_machines() -> None:
    assert server_time({"time": 5000.0}, 2.5) == 5002.5
    assert server_time({}, 2.5) > 1e9  # an older server: this machine's


def test_workers_that_left_long_ago_are_only_counted() -> None:
    workers = [
        WorkerFacts("a", "alive", 3, 9999.0),
        WorkerFacts("b", "left", 2, 30.0),
        WorkerFacts("c", "left", 1, 5000.0),
    ]
    shown, others = recent_workers(workers, 16)
    assert ([worker.name for worker in shown], others) == (["a", "b"], 1)
    assert recent_workers(workers, 1) == (workers[:1], 2)
