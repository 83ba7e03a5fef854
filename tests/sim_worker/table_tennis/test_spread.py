import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crkr.sim_worker.table_tennis.spread import spread_out


@given(st.integers(1, 30), st.floats(0.1, 4.0), st.integers(0, 1000))
def test_every_point_comes_once_those_inside_first(count: int, radius: float, seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    order = list(spread_out(points, radius))
    assert sorted(order) == list(range(count))
    inside = np.linalg.norm(points, axis=1)[order] <= radius
    assert (np.diff(inside.astype(int)) <= 0).all()


@given(st.integers(2, 6), st.integers(0, 1000))
def test_greedy_centres_cover_within_twice_the_best_radius(count: int, seed: int) -> None:
    """Brute force over all choices of `count` centres among 9 points."""
    from itertools import combinations

    points = np.random.default_rng(seed).normal(size=(9, 2))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    best = min(apart[:, list(chosen)].min(axis=1).max() for chosen in combinations(range(9), count))
    greedy = list(spread_out(points, np.inf))[:count]
    assert apart[:, greedy].min(axis=1).max() <= 2 * best + 1e-12
