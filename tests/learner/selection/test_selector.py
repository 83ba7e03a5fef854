"""The contract of every selector; a rival joins by adding its factory to the list."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from crkr.experiments.study.selectors import RIVAL_SELECTORS
from crkr.learner import SELECTORS, Anms, Selector, SelectorFactory, accelerate

BUDGET = 7
FACTORIES: dict[str, SelectorFactory] = {**RIVAL_SELECTORS, "anms by tree": partial(Anms, tree_from=0)}


@pytest.fixture(autouse=True, scope="module")
def compiled() -> None:
    assert accelerate()


@pytest.fixture(params=sorted(FACTORIES))
def factory(request: pytest.FixtureRequest) -> SelectorFactory:
    return FACTORIES[request.param]


def samples(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(size=(count, 3)), rng.uniform(size=count)


def replayed(factory: SelectorFactory) -> Selector:
    """A selector after a fixed story of every kind of event."""
    Z, costs = samples(40)
    selector = factory(3, BUDGET)
    selector.extend(Z[:25], costs[:25])
    selector.remove(int(selector.active[0]))
    selector.recost(11, 0.001)
    selector.extend(Z[25:], costs[25:])
    selector.set_budget(BUDGET + 2)
    selector.remove(30)
    return selector


def test_nothing_is_active_at_first(factory: SelectorFactory) -> None:
    assert len(factory(3, BUDGET).active) == 0


def test_all_samples_are_active_while_they_fit_the_budget(factory: SelectorFactory) -> None:
    selector = factory(3, BUDGET)
    for count in range(1, BUDGET + 1):
        Z, costs = samples(count)
        selector.extend(Z[-1:], costs[-1:])
        assert selector.active.tolist() == list(range(count))


def test_active_numbers_are_ascending_known_and_within_the_budget(factory: SelectorFactory) -> None:
    selector = factory(3, BUDGET)
    for step in range(30):
        selector.extend(*samples(2, step))
        active = selector.active.tolist()
        assert active == sorted(set(active))
        assert active[-1] < 2 * (step + 1)
        if factory is not SELECTORS["full"]:
            assert len(active) <= BUDGET


def test_a_removed_sample_is_never_active_again(factory: SelectorFactory) -> None:
    selector = factory(3, BUDGET)
    selector.extend(*samples(20))
    gone = selector.active.tolist()[:3]
    for index in gone:
        selector.remove(index)
    selector.extend(*samples(20, 1))
    selector.recost(15, 0.0)
    selector.set_budget(BUDGET + 5)
    assert not set(gone) & set(selector.active.tolist())


def test_the_same_story_gives_the_same_active_set(factory: SelectorFactory) -> None:
    assert replayed(factory).active.tolist() == replayed(factory).active.tolist()


def test_a_rebuild_from_the_present_samples_changes_nothing(factory: SelectorFactory) -> None:
    Z, costs = samples(40)
    selector = replayed(factory)
    costs[11] = 0.001
    first = factory(3, BUDGET)
    first.extend(Z[:25], samples(40)[1][:25])
    gone = {int(first.active[0]), 30}
    kept = np.array([index for index in range(40) if index not in gone])
    expected = selector.active
    selector.rebuild(Z[kept], costs[kept], selector.radii())
    np.testing.assert_array_equal(kept[selector.active], expected)


def test_a_group_is_the_same_as_its_samples_in_turn(factory: SelectorFactory) -> None:
    together, in_turn = factory(3, BUDGET), factory(3, BUDGET)
    Z, costs = samples(30)
    together.extend(Z, costs)
    for index in range(30):
        in_turn.extend(Z[index : index + 1], costs[index : index + 1])
    assert together.active.tolist() == in_turn.active.tolist()


def test_an_active_set_cannot_be_written_to(factory: SelectorFactory) -> None:
    selector = factory(3, BUDGET)
    selector.extend(*samples(3))
    with pytest.raises(ValueError, match="read-only"):
        selector.active[0] = 5


def test_freeze_keeps_the_oldest_and_full_keeps_all() -> None:
    freeze, full = SELECTORS["freeze"](3, BUDGET), SELECTORS["full"](3, BUDGET)
    for selector in (freeze, full):
        selector.extend(*samples(20))
        selector.remove(2)
    assert freeze.active.tolist() == [0, 1, 3, 4, 5, 6, 7]
    assert full.active.tolist() == [index for index in range(20) if index != 2]
