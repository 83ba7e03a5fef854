"""A calibration that several threads compute is the one of all its trials, or not there yet."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from crkr.learner.exploration.outcome_index import ObservedTrials, OutcomeIndex
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.exploration.prequential import Calibration, DeferredCalibration
from crkr.learner.samples.store import SampleStore
from crkr.protocol import TaskSpec, Trial

MakeSpec = Callable[..., TaskSpec]
Steps = list[tuple[ObservedTrials, ObservedTrials]]
Defer = Callable[[Steps], DeferredCalibration]

OUTCOME = [{"name": name, "tolerance": 0.1, "group": "miss"} for name in "ab"]
COUNT = 60
PATIENCE_S = 60.0


class WatchedSteps(Steps):
    """Steps that call `halfway` in the middle of each part that is taken."""

    def __init__(self, steps: Steps, halfway: Callable[[], None]) -> None:
        super().__init__(steps)
        self.halfway = halfway

    def __getitem__(self, part: Any) -> Any:
        return self._taken(super().__getitem__(part))

    def _taken(self, steps: Steps) -> Iterator[tuple[ObservedTrials, ObservedTrials]]:
        for number, step in enumerate(steps):
            if number == len(steps) // 2:
                self.halfway()
            yield step


@pytest.fixture
def spec(make_spec: MakeSpec) -> TaskSpec:
    return make_spec(2, 2, outcome=OUTCOME, exploration={"type": "outcome"})


@pytest.fixture
def steps(spec: TaskSpec) -> Steps:
    store, rng = SampleStore(2, 2, 2), np.random.default_rng(1)
    index = OutcomeIndex(OutcomeScales.of(spec), store)
    for number in range(COUNT):
        state, goal = rng.uniform(-1.0, 1.0, (2, 2))
        outcome = 0.3 * state + goal + 0.05 * rng.normal(size=2)
        success = bool(np.abs(outcome).max() < 0.5)
        trial = Trial(UUID(int=number + 1), state, goal, 0.5, success, "trial", outcome)
        index.extend(np.array([store.append(number + 2, trial)]))
    return list(pairwise([*(index.before(position) for position in range(COUNT)), index.snapshot()]))


@pytest.fixture
def defer(spec: TaskSpec) -> Defer:
    return lambda steps: DeferredCalibration(spec.exploration, OutcomeScales.of(spec), 0, 0, steps)


def numbers(calibration: Calibration) -> list[list[float]]:
    assert calibration.curve is not None
    assert calibration.spread is not None
    return [calibration.curve.weights.tolist(), calibration.spread.tolist()]


def test_while_a_thread_adds_the_last_trials_no_other_takes_them_for_added(steps: Steps, defer: Defer) -> None:
    adding, go_on = threading.Event(), threading.Event()

    def halfway() -> None:
        adding.set()
        assert go_on.wait(PATIENCE_S)

    calibration, found = defer(WatchedSteps(steps, halfway)), list[Calibration]()
    threads = [threading.Thread(target=calibration.advance, args=(COUNT,))]
    threads[0].start()
    assert adding.wait(PATIENCE_S)
    told = [calibration.advance(0), calibration.advance(7)]  # the first as a thread asks that answers all clients
    threads.append(threading.Thread(target=lambda: found.append(calibration.get())))
    threads[1].start()
    go_on.set()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert told == [False, False]
    assert calibration.advance(0)
    whole = defer(steps)
    assert numbers(found[0]) == numbers(calibration.get()) == numbers(whole.get())
    assert calibration.record().drift_score == whole.record().drift_score


def test_after_an_error_amid_the_trials_none_is_left_out_or_added_twice(steps: Steps, defer: Defer) -> None:
    errors: list[BaseException] = [KeyboardInterrupt(), MemoryError()]

    def halfway() -> None:
        if errors:
            raise errors.pop()

    calibration = defer(WatchedSteps(steps, halfway))
    for error in (MemoryError, KeyboardInterrupt):
        with pytest.raises(error):
            calibration.advance(COUNT)
        assert not calibration.advance(0)
    while not calibration.advance(7):
        pass
    assert numbers(calibration.get()) == numbers(defer(steps).get())


def test_a_calibration_of_no_trials_is_there_at_once(defer: Defer) -> None:
    calibration = defer([])
    assert calibration.advance(0)
    assert calibration.get().curve is None
