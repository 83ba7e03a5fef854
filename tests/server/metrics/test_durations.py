"""Durations are all recorded, from any thread, and counted as numpy counts."""

import threading
from collections.abc import Sequence

import numpy as np

from crkr.server.metrics.durations import BOUNDS_S, Durations, Latencies


def made() -> Durations:
    return Durations("work_seconds", "Work.")


def counts(durations: Durations) -> Sequence[float]:
    """How many took at most each bound, then how many there were in all."""
    [metric] = durations.collect()
    return [sample.value for sample in metric.samples if sample.name == "work_seconds_bucket"]


def total(durations: Durations) -> float:
    [metric] = durations.collect()
    [found] = [sample.value for sample in metric.samples if sample.name == "work_seconds_sum"]
    return found


def test_the_histogram_counts_every_time_at_or_below_each_bound() -> None:
    rng = np.random.default_rng(0)
    times = np.concatenate([10.0 ** rng.uniform(-5, 1.5, 5000), BOUNDS_S, [0.0, 99.0]])
    durations = made()
    for time in times.tolist():
        durations.record(time)
    assert counts(durations) == [int((times <= bound).sum()) for bound in BOUNDS_S] + [len(times)]
    assert np.isclose(total(durations), times.sum(), rtol=1e-12)


def test_only_the_last_times_are_recent_and_all_are_counted() -> None:
    latencies, durations = Latencies(), made()
    for number in range(5000):
        durations.record(float(number))
        latencies.record("predict", 1e-6 * number)
    assert durations.recent().tolist() == list(range(3976, 5000))
    assert counts(durations)[-1] == 5000
    assert latencies.summary()["predict"] == {"p50": 4487.5, "p99": 4988.8, "count": 5000}


def test_nothing_recorded_is_nothing_counted() -> None:
    durations = made()
    assert len(durations.recent()) == 0
    assert (set(counts(durations)), total(durations)) == ({0}, 0.0)
    assert Latencies().summary() == {}


def test_threads_that_record_while_others_ask_lose_nothing() -> None:
    durations, each, seen = made(), 20_000, []

    def record() -> None:
        for _ in range(each):
            durations.record(0.5)

    recording = [threading.Thread(target=record) for _ in range(4)]
    for thread in recording:
        thread.start()
    while any(thread.is_alive() for thread in recording):
        seen.append(counts(durations)[-1])
        assert set(durations.recent()) <= {0.5}
    assert seen == sorted(seen)
    assert counts(durations)[-1] == 4 * each
    assert total(durations) == 0.5 * 4 * each


def test_a_block_that_raises_is_not_timed() -> None:
    durations = made()
    try:
        with durations.timing():
            raise KeyError
    except KeyError:
        pass
    with durations.timing():
        pass
    assert counts(durations)[-1] == 1
