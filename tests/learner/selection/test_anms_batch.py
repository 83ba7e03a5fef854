from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crkr.learner import radii, radii_kdtree, top
from crkr.protocol import Array


def by_hand(Z: Array, costs: Array) -> list[float]:
    """Algorithm 2 as the paper lists it, in plain Python."""
    order = sorted(range(len(costs)), key=lambda index: (costs[index], index))
    found = [np.inf] * len(costs)
    for rank, index in enumerate(order[1:], start=1):
        found[index] = min(float(np.linalg.norm(Z[index] - Z[other])) for other in order[:rank])
    return found


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 6), st.booleans())
def test_radii_are_those_of_algorithm_two(seed: int, n: int, d: int, ties: bool) -> None:
    rng = np.random.default_rng(seed)
    Z = rng.integers(0, 3, (n, d)).astype(float) if ties else rng.normal(size=(n, d))
    costs = rng.integers(0, 3, n) / 3 if ties else rng.uniform(size=n)
    r2, suppressor = radii(Z, costs)
    np.testing.assert_allclose(np.sqrt(r2), by_hand(Z, costs), rtol=1e-12)
    assert np.flatnonzero(suppressor < 0).tolist() == [min(range(n), key=lambda index: (costs[index], index))]


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 900),
    st.integers(1, 6),
    st.sampled_from(["uniform", "lattice", "tenths", "duplicates", "sorted cost"]),
)
def test_tree_and_obvious_form_give_the_same_bits(seed: int, n: int, d: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    Z: Array = rng.uniform(size=(n, d))
    costs: Array = rng.uniform(size=n)
    if kind == "lattice":
        Z, costs = rng.integers(0, 4, (n, d)).astype(float), rng.integers(0, 5, n) / 5
    elif kind == "tenths":  # equal distances that rounding tells apart
        Z = 0.1 * rng.integers(0, 4, (n, d)).astype(np.float64)
    elif kind == "duplicates":
        Z = np.repeat(rng.uniform(size=(1, d)), n, axis=0)
    elif kind == "sorted cost":
        costs = Z[:, 0].copy()
    r2, suppressor = radii(Z, costs)
    tree_r2, tree_suppressor = radii_kdtree(Z, costs)
    np.testing.assert_array_equal(tree_r2, r2)
    apart = r2 > 0
    np.testing.assert_array_equal(tree_suppressor[apart], suppressor[apart])


@pytest.mark.parametrize("states", [2, 5])
def test_states_that_come_again_and_again_take_no_memory_for_each_pair_of_them(states: int) -> None:
    rng = np.random.default_rng(states)
    which = rng.integers(0, states, 4000)
    Z, costs = rng.uniform(size=(states, 2))[which], which / 8 + 0.01 * rng.uniform(size=4000)  # each state costs alike
    tracemalloc.start()
    r2, suppressor = radii_kdtree(Z, costs)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 8 * 4000 * 200
    true_r2, true_suppressor = radii(Z, costs)
    np.testing.assert_array_equal(r2, true_r2)
    np.testing.assert_array_equal(suppressor[r2 > 0], true_suppressor[r2 > 0])


@given(st.lists(st.integers(0, 5), min_size=1, max_size=30), st.integers(1, 35))
def test_top_takes_the_largest_and_of_equals_the_older(values: list[int], k: int) -> None:
    order = sorted(range(len(values)), key=lambda index: (-values[index], index))
    assert top(np.array(values, dtype=float), k).tolist() == sorted(order[:k])


@pytest.mark.parametrize("n", [0, 1])
def test_none_or_one_sample_need_no_search(n: int) -> None:
    r2, suppressor = radii_kdtree(np.zeros((n, 2)), np.zeros(n))
    assert r2.tolist() == [np.inf] * n
    assert suppressor.tolist() == [-1] * n
