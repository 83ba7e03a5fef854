"""Durations lose none, whoever records, and are counted as numpy counts."""

import threading

import numpy as np

from crkr.server.metrics.durations import BOUNDS_S, Durations


def test_the_histogram_counts_every_time_at_or_below_each_bound() -> None:
    rng = np.random.default_rng(0)
    times = np.concatenate([10.0 ** rng.uniform(-5, 1.5, 5000), BOUNDS_S, [0.0, 99.0]])
    durations = Durations()
    for time in times.tolist():
        durations.record(time)
    found = durations.histogram()
    assert list(found.counts) == [int((times <= bound).sum()) for bound in BOUNDS_S] + [len(times)]
    assert np.isclose(found.total_s, times.sum(), rtol=1e-12)
    assert durations.count == len(times)


def test_only_the_last_times_are_recent_and_all_are_counted() -> None:
    durations = Durations()
    for number in range(5000):
        durations.record(float(number))
    assert durations.recent().tolist() == list(range(3976, 5000))
    assert durations.count == 5000


def test_nothing_recorded_is_nothing_counted() -> None:
    durations = Durations()
    assert len(durations.recent()) == 0
    assert (set(durations.histogram().counts), durations.histogram().total_s) == ({0}, 0.0)


def test_threads_that_record_while_others_ask_lose_nothing() -> None:
    durations, each, seen = Durations(), 20_000, []

    def record() -> None:
        for _ in range(each):
            durations.record(0.5)

    recording = [threading.Thread(target=record) for _ in range(4)]
    for thread in recording:
        thread.start()
    while any(thread.is_alive() for thread in recording):
        seen.append(durations.histogram().counts[-1])
    assert seen == sorted(seen)
    assert durations.histogram().counts[-1] == durations.count == 4 * each
    assert durations.histogram().total_s == 0.5 * 4 * each


def test_a_block_that_raises_is_not_timed() -> None:
    durations = Durations()
    try:
        with durations.timing():
            raise KeyError
    except KeyError:
        pass
    with durations.timing():
        pass
    assert durations.count == 1
