"""What the outcome model looks up, beside the plain list of what the store holds."""

from __future__ import annotations

from collections.abc import Callable
from uuid import uuid4

import numpy as np
import pytest

from crkr.learner.exploration.outcome_index import SEARCHED, ObservedTrials, OutcomeIndex
from crkr.learner.exploration.outcome_neighbours import nearest
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.exploration.sealed_trials import UNIT
from crkr.learner.samples.columns import TrialColumns
from crkr.learner.samples.store import SampleStore
from crkr.protocol import KINDS, Array, TaskSpec, Trial

MakeSpec = Callable[..., TaskSpec]

OUTCOME = [{"name": name, "tolerance": 0.5, "target": 1.0, "group": name} for name in "ab"]


def filled(spec: TaskSpec, count: int) -> tuple[SampleStore, OutcomeIndex]:
    """A store and an index that followed it one trial at a time; every third trial was not observed."""
    store = SampleStore(2, 2, 2)
    index = OutcomeIndex(OutcomeScales.of(spec), store)
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
    """What `found` holds of these trials."""
    return np.array([number if number % 3 else np.nan for number in numbers], dtype=np.float64)


@pytest.mark.parametrize("count", [0, 1, 29, 200])
def test_all_tried_goals_are_searched_whenever_one_looks(make_spec: MakeSpec, count: int) -> None:
    _, index = filled(make_spec(outcome=OUTCOME), count)
    expected = list(range(count))
    np.testing.assert_allclose(found(index), observed(expected))
    trials = index.snapshot()
    np.testing.assert_allclose(trials.single[:, :4], trials.X, rtol=1e-6)
    np.testing.assert_allclose(trials.single[:, 4], np.sum(trials.X**2, axis=1), rtol=1e-6)
    assert not trials.single[:, 5:].any()
    odd = [place for place, number in enumerate(expected) if number % 2 and number % 3]
    hidden = trials.hidden[1]
    assert (list(range(len(expected))) if hidden is None else np.flatnonzero(hidden == 0).tolist()) == odd
    assert trials.counts[1] == len(odd)


def test_removed_trials_are_searched_no_more(make_spec: MakeSpec) -> None:
    store, index = filled(make_spec(outcome=OUTCOME), 100)
    before = index.snapshot()
    kept = before.Y.copy()
    for row in (98, 97, 4):
        store.remove(row)
    assert index.holds(98)
    assert index.holds(4)
    assert index.holds(99)  # it was tried, though not observed
    index.rebuild()
    np.testing.assert_allclose(found(index), observed([*range(4), *range(5, 97), 99]))
    np.testing.assert_array_equal(before.Y, kept)


def test_the_trials_before_a_change_are_kept_apart_until_enough_came_since(make_spec: MakeSpec) -> None:
    store, index = filled(make_spec(outcome=OUTCOME), 100)
    index.restart(3)
    store.remove(4)
    index.rebuild()
    assert index.holds(5)
    np.testing.assert_allclose(found(index), observed([97, 98, 99]))
    former = index.snapshot().former
    assert former is not None
    np.testing.assert_allclose(former.Y[:, 0] * 0.5 + 1.0, observed([*range(4), *range(5, 97)]))
    assert index.snapshot().enough(90) == ()
    assert index.snapshot().enough(60) == (0,)
    for number in range(100, 600):
        index.extend(np.array([store.append(number + 2, a_trial(number))]))
    assert index.before(100).former is former
    assert index.snapshot().former is None
    index.restart(3)
    index.rebuild()
    former = index.snapshot().former
    assert former is not None
    assert len(former) == 500  # trials before the first change are useless


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


def many(count: int, first: int = 0) -> TrialColumns:
    """Trials around a slow walk; the second outcome is observed in half of them, one in fifty is refused."""
    rng = np.random.default_rng(first)
    away = np.arange(first, first + count)[:, None] / 20_000
    outcomes = rng.normal(size=(count, 2))
    outcomes[rng.uniform(size=count) < 0.5, 1] = np.nan
    kinds = np.where(rng.uniform(size=count) < 0.02, KINDS.index("failed"), KINDS.index("trial")).astype(np.uint8)
    return TrialColumns(
        seqs=np.arange(first, first + count) + 2,
        ids=rng.bytes(16 * count),
        digests=rng.bytes(16 * count),
        states=np.sin(away) + 0.3 * rng.normal(size=(count, 2)),
        goals=np.cos(away) + 0.3 * rng.normal(size=(count, 2)),
        costs=rng.uniform(size=count),
        kinds=kinds,
        flags=np.zeros(count, dtype=np.uint8),
        outcomes=outcomes,
    )


def followed(spec: TaskSpec, groups: list[int]) -> tuple[SampleStore, OutcomeIndex]:
    """A store and an index that followed it by groups of these sizes."""
    store = SampleStore(2, 2, 2)
    index = OutcomeIndex(OutcomeScales.of(spec), store)
    trials = many(sum(groups))
    store.extend(trials)
    for first, count in zip(np.cumsum([0, *groups[:-1]]).tolist(), groups, strict=True):
        index.extend(np.arange(first, first + count))
    return store, index


def neighbours(trials: ObservedTrials, group: int) -> bytes:
    points = trials.X[:: len(trials) // 7]
    return b"".join(part.tobytes() for part in nearest(trials, points, [group], 60))


@pytest.mark.parametrize("count", [SEARCHED + 1, SEARCHED + 5 * UNIT + 100])
def test_many_trials_have_the_same_neighbours_however_they_came(make_spec: MakeSpec, count: int) -> None:
    spec = make_spec(outcome=OUTCOME)
    _, at_once = followed(spec, [count])
    store, in_turn = followed(spec, [10_000] + [500] * ((count - 10_000) // 500) + [(count - 10_000) % 500])
    restored = OutcomeIndex(OutcomeScales.of(spec), store)
    restored.rebuild()
    for group in (0, 1, 2):
        assert neighbours(at_once.snapshot(), group) == neighbours(in_turn.snapshot(), group)
        assert neighbours(at_once.snapshot(), group) == neighbours(restored.snapshot(), group)


def test_what_was_searched_before_can_be_searched_again(make_spec: MakeSpec) -> None:
    groups = [SEARCHED - 10, 20, UNIT, 50, 3 * UNIT, 5]
    _, index = followed(make_spec(outcome=OUTCOME), groups)
    for position in np.cumsum(groups).tolist():
        then = followed(make_spec(outcome=OUTCOME), [sum(groups)])[1].before(position)
        assert neighbours(then, 1) == neighbours(index.before(position), 1)
        assert len(then) == position
        assert then.counts[0] == then.counts[2] == len(then.single)


def test_old_trials_are_found_where_they_are_nearest_and_none_that_hide_the_group(make_spec: MakeSpec) -> None:
    _, index = followed(make_spec(outcome=OUTCOME), [SEARCHED + 9 * UNIT])
    trials = index.snapshot()
    assert len(trials.single) < SEARCHED < len(trials)
    points = trials.X[:SEARCHED:997] + 0.01
    for group in (0, 1):
        found = nearest(trials, points, [group], 60)
        seen = ~np.isnan(trials.Y[:, group])
        assert seen[found.rows].all()
        right = 0
        for place, point in enumerate(points):
            squared = np.where(seen, np.sum((trials.X - point) ** 2, axis=1), np.inf)
            right += len(set(squared.argsort()[:60].tolist()) & set(found.rows[0, place].tolist()))
            np.testing.assert_array_equal(found.D[0, place], trials.X[found.rows[0, place]] - point)
        assert right > 0.95 * 60 * len(points)


def test_trials_with_absurd_numbers_are_sealed_too(make_spec: MakeSpec) -> None:
    store = SampleStore(2, 2, 2)
    trials = many(SEARCHED + UNIT)
    trials.states[::1000] = 1e60
    store.extend(trials)
    index = OutcomeIndex(OutcomeScales.of(make_spec(outcome=OUTCOME)), store)
    index.extend(np.arange(len(trials)))
    found = nearest(index.snapshot(), index.snapshot().X[[5, 1000]], [0, 2], 60)
    assert found.squared[0, 0].max() < 1.0
    assert found.squared[1, 1].min() == 0.0
