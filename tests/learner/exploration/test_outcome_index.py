"""What the outcome model looks up, beside the plain list of what the store holds."""

from __future__ import annotations

from collections.abc import Callable
from uuid import uuid4

import numpy as np
import pytest

from crkr.learner.exploration.outcome_index import OutcomeIndex
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.samples.store import SampleStore
from crkr.protocol import Array, TaskSpec, Trial

MakeSpec = Callable[..., TaskSpec]

SEARCHED = 20
OUTCOME = [{"name": name, "tolerance": 0.5, "target": 1.0, "group": name} for name in "ab"]


def filled(spec: TaskSpec, count: int) -> tuple[SampleStore, OutcomeIndex]:
    """A store and an index that followed it one trial at a time; every third trial was not observed."""
    store = SampleStore(2, 2, 2)
    index = OutcomeIndex(OutcomeScales.of(spec), store, SEARCHED)
    for number in range(count):
        index.extend(np.array([store.append(number + 2, a_trial(number, seen=bool(number % 3)))]))
    return store, index


def a_trial(number: int, *, seen: bool = True, kind: str = "trial") -> Trial:
    outcome = np.array([number, number if number % 2 else np.nan]) if seen else None
    return Trial(uuid4(), np.full(2, number / 100), np.zeros(2), 0.5, False, kind, outcome)


def found(index: OutcomeIndex) -> Array:
    """The first entries of the trials that are searched, in their units."""
    return np.asarray(index.snapshot().Y[:, 0] * 0.5 + 1.0)


def observed(numbers: list[int]) -> Array:
    """What `found` tells of these trials."""
    return np.array([number if number % 3 else np.nan for number in numbers], dtype=np.float64)


@pytest.mark.parametrize("count", [0, 1, 29, 31, 60, 61, 62, 200])
def test_the_newest_tried_goals_are_searched_whenever_one_looks(make_spec: MakeSpec, count: int) -> None:
    _, index = filled(make_spec(outcome=OUTCOME), count)
    expected = list(range(count))[-SEARCHED:]
    np.testing.assert_allclose(found(index), observed(expected))
    trials = index.snapshot()
    np.testing.assert_allclose(trials.single[:, :4], trials.X, rtol=1e-6)
    np.testing.assert_allclose(trials.single[:, 4], np.sum(trials.X**2, axis=1), rtol=1e-6)
    assert not trials.single[:, 5:].any()
    odd = [place for place, number in enumerate(expected) if number % 2 and number % 3]
    hidden = trials.hidden[1]
    assert (list(range(len(expected))) if hidden is None else np.flatnonzero(hidden == 0).tolist()) == odd
    assert trials.counts[1] == len(odd)


def test_older_trials_come_back_where_newer_ones_are_removed(make_spec: MakeSpec) -> None:
    store, index = filled(make_spec(outcome=OUTCOME), 100)
    before = index.snapshot()
    kept = before.Y.copy()
    for row in (98, 97, 4):
        store.remove(row)
    assert index.holds(98)
    assert index.holds(4)  # at hand for what was searched when newer ones came
    assert index.holds(99)  # it was tried, though not observed
    index.rebuild(index.usable(np.arange(len(store))))
    np.testing.assert_allclose(found(index), observed([*range(97), 99][-SEARCHED:]))
    np.testing.assert_array_equal(before.Y, kept)


def test_a_snapshot_stays_while_trials_come(make_spec: MakeSpec) -> None:
    store, index = filled(make_spec(outcome=OUTCOME), 30)
    before, kept = index.snapshot(), found(index)
    assert index.snapshot() is before
    assert not index.extend(np.array([store.append(200, a_trial(200, kind="evaluation"))]))
    assert index.snapshot() is before
    for number in range(201, 300):
        index.extend(np.array([store.append(number, a_trial(number))]))
    np.testing.assert_array_equal(before.Y[:, 0] * 0.5 + 1.0, kept)
    for array in (before.X, before.single, before.Y):
        with pytest.raises(ValueError, match="read-only"):
            array.flat[0] = 1.0


def test_states_are_measured_by_the_box_where_the_kernels_reach_is_longer(make_spec: MakeSpec) -> None:
    axes = [{"name": name, "low": -2, "high": 6, "lengthscale": scale} for name, scale in (("x", 0.5), ("y", 30.0))]
    spec = TaskSpec.from_dict({**make_spec(outcome=OUTCOME).to_dict(), "state": axes})
    points = OutcomeScales.of(spec).points(np.array([[3.0, 3.0]]), np.array([[0.25, 3.0]]))
    np.testing.assert_allclose(points, [[2.0, 0.5, 0.25, 1.0]])  # goals count half, and stay in their bounds
