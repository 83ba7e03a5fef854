from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from crkr.learner import Anms, accelerate, radii, radii_kdtree, top
from crkr.protocol import Array

STREAMS = ("uniform", "lattice", "cluster", "drift", "falling cost", "one state", "line")
Form = Callable[[int, int], Anms]
FORMS: dict[str, Form] = {"passes over all": partial(Anms, tree_from=10**9), "tree": partial(Anms, tree_from=0)}


@pytest.fixture(autouse=True, scope="module")
def compiled() -> None:
    assert accelerate()


class AnmsAgainstTheBatchAlgorithm(RuleBasedStateMachine):
    """Any sequence of calls; after each the incremental filter must hold what the batch algorithm finds."""

    @initialize(
        d=st.integers(1, 6),
        budget=st.integers(1, 12),
        stream=st.sampled_from(STREAMS),
        seed=st.integers(0, 2**32 - 1),
        form=st.sampled_from(sorted(FORMS)),
    )
    def start(self, d: int, budget: int, stream: str, seed: int, form: str) -> None:
        self.d, self.budget, self.stream = d, budget, stream
        self.rng = np.random.default_rng(seed)
        self.anms = FORMS[form](d, budget)
        self.Z, self.costs = np.empty((0, d)), np.empty(0)

    def state(self) -> np.ndarray:
        if self.stream == "lattice":  # duplicates and equal distances
            return self.rng.integers(0, 3, self.d) * 0.1
        if self.stream == "cluster":
            return self.rng.integers(0, 3) + 1e-3 * self.rng.normal(size=self.d)
        if self.stream == "drift":
            return self.rng.normal(size=self.d) + 0.1 * len(self.costs)
        if self.stream == "one state":
            return np.full(self.d, 0.5)
        if self.stream == "line":
            return np.full(self.d, self.rng.uniform())
        return self.rng.uniform(size=self.d)

    def cost(self) -> float:
        if self.stream == "falling cost":
            return 1.0 / (1 + len(self.costs))
        return float(self.rng.integers(0, 4) / 4 if self.stream == "lattice" else self.rng.uniform())

    def add(self, count: int) -> None:
        Z = np.array([self.state() for _ in range(count)]).reshape(count, self.d)
        costs = np.array([self.cost() for _ in range(count)])
        self.anms.extend(Z, costs)
        self.Z, self.costs = np.concatenate([self.Z, Z]), np.concatenate([self.costs, costs])

    def some_samples(self, most: int) -> np.ndarray:
        alive = np.flatnonzero(~np.isnan(self.costs))
        return self.rng.choice(alive, min(most, len(alive)), replace=False)

    @rule(count=st.one_of(st.integers(1, 8), st.integers(30, 90)))
    def insert(self, count: int) -> None:
        self.add(count)

    @precondition(lambda self: not np.isnan(self.costs).all())
    @rule(most=st.one_of(st.integers(1, 3), st.integers(10, 60)))
    def remove(self, most: int) -> None:
        gone = self.some_samples(most)
        self.anms.remove(gone)
        self.costs[gone] = np.nan

    @precondition(lambda self: not np.isnan(self.costs).all())
    @rule(most=st.one_of(st.integers(1, 3), st.integers(10, 60)))
    def recost(self, most: int) -> None:
        changed = self.some_samples(most)
        self.costs[changed] = [self.cost() for _ in changed]
        self.anms.recost(changed, self.costs[changed])

    @rule(budget=st.integers(1, 12))
    def set_budget(self, budget: int) -> None:
        self.budget = budget
        self.anms.set_budget(budget)

    @rule()
    def rebuild(self) -> None:
        alive = ~np.isnan(self.costs)
        self.Z, self.costs = self.Z[alive], self.costs[alive]
        self.anms.rebuild(self.Z, self.costs)

    @rule()
    def rebuild_from_cached_radii(self) -> None:
        cached = self.anms.radii()
        alive = ~np.isnan(self.costs)
        self.Z, self.costs = self.Z[alive], self.costs[alive]
        self.anms.rebuild(self.Z, self.costs, cached)

    @invariant()
    def active_set_and_radii_are_those_of_the_batch_algorithm(self) -> None:
        alive = np.flatnonzero(~np.isnan(self.costs))
        r2, suppressor = radii(self.Z[alive], self.costs[alive])
        np.testing.assert_array_equal(self.anms.active, alive[top(r2, self.budget)])
        for position, index in enumerate(alive.tolist()):
            standing = self.anms.standing(index)
            if suppressor[position] < 0:
                assert standing.suppressor is None
                continue
            assert standing.radius == np.sqrt(r2[position])
            assert standing.suppressor is not None
            gap = self.Z[index] - self.Z[standing.suppressor]
            assert np.linalg.norm(gap) == pytest.approx(standing.radius, rel=1e-12)
            better = (self.costs[standing.suppressor], standing.suppressor) < (self.costs[index], index)
            assert better, "the suppressor is not better"


TestAnmsAgainstTheBatchAlgorithm = AnmsAgainstTheBatchAlgorithm.TestCase
TestAnmsAgainstTheBatchAlgorithm.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


@pytest.fixture(params=sorted(FORMS))
def form(request: pytest.FixtureRequest) -> Form:
    return FORMS[request.param]


@pytest.mark.parametrize("budget", [1, 10, 60])
def test_a_long_stream_keeps_the_batch_algorithms_set(budget: int, form: Form) -> None:
    rng = np.random.default_rng(budget)
    Z, costs = rng.uniform(size=(1500, 3)), rng.uniform(size=1500)
    anms = form(3, budget)
    for count in range(1500):
        anms.extend(Z[count : count + 1], costs[count : count + 1])
        if count % 97 == 0 or count == 1499:
            r2, _ = radii(Z[: count + 1], costs[: count + 1])
            np.testing.assert_array_equal(anms.active, top(r2, budget))


def test_a_large_group_gives_the_same_set_as_one_by_one(form: Form) -> None:
    rng = np.random.default_rng(0)
    Z, costs = rng.uniform(size=(14000, 2)), rng.uniform(size=14000)
    together, one_by_one = form(2, 50), form(2, 50)
    together.extend(Z, costs)  # large enough for the batch build
    for start in range(0, 14000, 100):
        one_by_one.extend(Z[start : start + 100], costs[start : start + 100])
    np.testing.assert_array_equal(together.active, one_by_one.active)
    np.testing.assert_array_equal(together.radii().squared, one_by_one.radii().squared)
    np.testing.assert_array_equal(together.radii().suppressor, one_by_one.radii().suppressor)


def test_of_equal_costs_the_older_is_the_better() -> None:
    anms = Anms(1, 1)
    anms.extend(np.array([[0.0], [1.0]]), np.array([0.5, 0.5]))
    assert anms.active.tolist() == [0]
    assert anms.standing(1).suppressor == 0


def test_of_equal_radii_the_older_is_kept() -> None:
    anms = Anms(1, 2)
    anms.extend(np.array([[0.0], [1.0], [-1.0]]), np.array([0.0, 0.5, 0.4]))
    assert anms.active.tolist() == [0, 1]


def test_the_active_set_is_the_same_object_while_nothing_changes() -> None:
    anms = Anms(1, 2)
    anms.extend(np.array([[0.0], [10.0]]), np.array([0.1, 0.2]))
    before = anms.active
    anms.extend(np.array([[0.01]]), np.array([0.9]))
    assert anms.active is before
    with pytest.raises(ValueError, match="read-only"):
        before[0] = 1


@pytest.mark.parametrize("alike", [True, False])
def test_removing_and_recosting_many_at_once_is_the_same_as_one_by_one(alike: bool, form: Form) -> None:
    rng = np.random.default_rng(1)
    Z: Array = np.zeros((300, 2)) if alike else rng.integers(0, 5, (300, 2)) / 10
    costs = rng.integers(0, 6, 300) / 6
    together, in_turn = form(2, 20), form(2, 20)
    changed, gone = rng.permutation(300)[:80], rng.permutation(300)[:90]
    for anms in (together, in_turn):
        anms.extend(Z, costs)
    new = rng.integers(0, 6, 80) / 6
    together.recost(changed, new)
    for index, cost in zip(changed.tolist(), new.tolist(), strict=True):
        in_turn.recost(index, cost)
    costs[changed] = new
    r2, _ = radii(Z, costs)
    np.testing.assert_array_equal(together.radii().squared, r2)
    np.testing.assert_array_equal(together.active, in_turn.active)
    together.remove(gone)
    for index in gone.tolist():
        in_turn.remove(index)
    left = np.delete(np.arange(300), gone)
    r2, _ = radii(Z[left], costs[left])
    for anms in (together, in_turn):
        np.testing.assert_array_equal(anms.radii().squared, r2)
        np.testing.assert_array_equal(anms.active, left[top(r2, 20)])


def test_a_sample_that_suppresses_thousands_is_removed_and_made_worse_exactly(form: Form) -> None:
    rng = np.random.default_rng(2)
    Z, costs = np.full((14_000, 3), 0.5), np.full(14_000, 0.5)  # a robot that starts from one state each time
    Z[13_000:] += rng.uniform(size=(1000, 3))
    anms = form(3, 50)
    anms.extend(Z, costs)
    anms.recost(0, 0.9)
    costs[0] = 0.9
    r2, _ = radii_kdtree(Z, costs)
    np.testing.assert_array_equal(anms.radii().squared, r2)
    anms.remove(np.array([1, 2, 3]))
    left = np.delete(np.arange(14_000), [1, 2, 3])
    r2, _ = radii_kdtree(Z[left], costs[left])
    np.testing.assert_array_equal(anms.radii().squared, r2)
    np.testing.assert_array_equal(anms.active, left[top(r2, 50)])


def test_the_tree_takes_over_where_it_pays_and_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    Z, costs = rng.uniform(size=(900, 3)), rng.uniform(size=900)
    late = Anms(3, 40, tree_from=500)
    for start in range(0, 900, 50):
        late.extend(Z[start : start + 50], costs[start : start + 50])
    r2, suppressor = radii(Z, costs)
    np.testing.assert_array_equal(late.radii().squared, r2)
    np.testing.assert_array_equal(late.radii().suppressor, suppressor)
    np.testing.assert_array_equal(late.active, top(r2, 40))


def churn(anms: Anms, stream: str, samples: int, changes: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Samples, then changes by hundreds: a third each come, go and change cost. What is left, NaN where removed."""
    made, Z, costs = 0, np.empty((0, 3)), np.empty(0)

    def add(count: int) -> None:
        nonlocal made, Z, costs
        new: Array = np.full((count, 3), 0.5)
        if stream != "one state":
            new += rng.uniform(size=(count, 1 if stream == "line" else 3))
        if stream == "drift":
            new += 1e-3 * np.arange(made, made + count)[:, None]
        made += count
        fresh = rng.integers(0, 50, count) / 50 if stream == "one state" else rng.uniform(size=count)
        anms.extend(new, fresh)
        Z, costs = np.concatenate([Z, new]), np.concatenate([costs, fresh])

    add(samples)
    for _ in range(0, changes, 300):
        add(100)
        chosen = rng.choice(np.flatnonzero(~np.isnan(costs)), 200, replace=False)
        anms.remove(chosen[:100])
        costs[chosen[:100]] = np.nan
        costs[chosen[100:]] = rng.uniform(size=100)
        anms.recost(chosen[100:], costs[chosen[100:]])
    return Z, costs


@pytest.mark.parametrize("stream", ["uniform", "one state", "line", "drift"])
@pytest.mark.parametrize("changes", [9_000, pytest.param(1_000_000, marks=pytest.mark.campaign)])
def test_thousands_of_changes_leave_the_batch_algorithms_radii(stream: str, changes: int) -> None:
    anms = Anms(3, 30, tree_from=0)
    Z, costs = churn(anms, stream, 4000, changes, np.random.default_rng(4))
    alive = ~np.isnan(costs)
    r2, _ = radii_kdtree(Z[alive], costs[alive])
    np.testing.assert_array_equal(anms.radii().squared, r2)
    np.testing.assert_array_equal(anms.active, np.flatnonzero(alive)[top(r2, 30)])
