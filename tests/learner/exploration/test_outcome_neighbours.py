"""The nearest trials beside a plain search through all of them, and in any company."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crkr.learner.exploration.outcome_index import ObservedTrials, in_single_precision
from crkr.learner.exploration.outcome_neighbours import nearest
from crkr.protocol import Array


def observed(X: Array, seen: NDArray[np.bool_]) -> ObservedTrials:
    single, fits = in_single_precision(X)
    hidden = [np.where(one, 0, np.inf).astype(np.float32) for one in seen.T]
    nowhere = np.zeros(len(X), dtype=np.bool_)
    return ObservedTrials.of(X, single, fits, np.zeros((len(X), seen.shape[1])), hidden, nowhere, nowhere, nowhere)


def assert_nearest(trials: ObservedTrials, seen: NDArray[np.bool_], x: Array, count: int) -> None:
    groups = list(range(seen.shape[1]))
    found = nearest(trials, x, groups, count)
    assert found.rows.shape == (len(groups), len(x), count)
    for group in groups:
        for place, point in enumerate(x):
            rows, D, squared = (part[group, place] for part in found)
            assert seen[rows, group].all()
            assert len(set(rows.tolist())) == count
            np.testing.assert_array_equal(D, trials.X[rows] - point)
            np.testing.assert_allclose(squared, np.sum(D * D, axis=1), rtol=1e-12)
            assert squared[-1] == squared.max()
            all_squared = np.sum((trials.X[seen[:, group]] - point) ** 2, axis=1)
            np.testing.assert_allclose(np.sort(squared), np.sort(all_squared)[:count], rtol=1e-12)


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.sampled_from([1, 7, 60, 300, 3000]),
    r=st.integers(1, 20),
    b=st.integers(1, 9),
    count=st.sampled_from([1, 5, 60]),
    scale=st.sampled_from([0.0, 1e-200, 1e-20, 1e-6, 1.0, 1e12, 1e20, 1e50]),
    away=st.sampled_from([0.0, 1.0, 1e4, 1e50]),
    offset=st.sampled_from([0.0, 30.0, 1e3]),
    steps=st.sampled_from([0, 2]),
    share=st.sampled_from([0.02, 0.6]),
)
def test_the_nearest_are_those_of_a_search_through_all(
    seed: int, n: int, r: int, b: int, count: int, scale: float, away: float, offset: float, steps: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    X, x = rng.normal(size=(n, r)), rng.normal(size=(b, r))
    if steps:  # many are equally far away, and some are the same
        X, x = np.round(X * steps), np.round(x * steps)
    X, x = X * scale + offset, x * scale + offset + away * rng.choice([0.0, 1.0], (b, 1))
    X[rng.uniform(size=n) < 0.01] *= 1e10 if scale < 1e40 else 1.0
    seen = np.stack([np.ones(n, dtype=bool), rng.uniform(size=n) < share], axis=1)
    seen[rng.integers(n), 1] = True
    assert_nearest(observed(X, seen), seen, x, min(count, int(seen[:, 1].sum())))


@pytest.mark.parametrize("n", [300, 20_000])
@pytest.mark.parametrize("away", [0.0, 1e3, 1e9])
def test_neighbours_have_the_same_bits_in_any_company(n: int, away: float) -> None:
    rng = np.random.default_rng(0)
    X, x = rng.normal(size=(n, 19)), rng.normal(size=(33, 19))
    x[::3] += away
    seen = np.stack([np.ones(n, dtype=bool), rng.uniform(size=n) < 0.5], axis=1)
    trials = observed(X, seen)
    together = nearest(trials, x, [0, 1], 60)
    for place in (0, 1, 16, 32):
        alone = nearest(trials, x[place : place + 1], [0, 1], 60)
        assert alone.rows[:, 0].tobytes() == together.rows[:, place].tobytes()
        assert alone.D[:, 0].tobytes() == together.D[:, place].tobytes()


def test_rounding_hides_no_neighbour_where_all_are_far_from_the_origin() -> None:
    rng = np.random.default_rng(2)
    X, x = 1e3 + rng.normal(size=(4000, 19)), 1e3 + rng.normal(size=(5, 19))
    seen = np.ones((4000, 1), dtype=bool)
    assert_nearest(observed(X, seen), seen, x, 60)


def test_few_are_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    X, x = rng.normal(size=(20_000, 19)), rng.normal(size=(32, 19)) * 0.5
    trials, measured, plain = observed(X, np.ones((20_000, 1), dtype=bool)), [], np.bincount

    def counted(points: NDArray[np.int64]) -> NDArray[np.int64]:
        measured.append(len(points))
        return plain(points)

    monkeypatch.setattr(np, "bincount", counted)
    nearest(trials, x, [0], 60)
    assert 60 <= measured[0] / 32 < 90
