"""The local line beside scikit-learn's, beside dense algebra, and beside a world that is a line."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.linear_model import Ridge

from crkr.learner.outcome_fit import RIDGE, LocalFit, fit_locally, nearest
from crkr.learner.outcome_index import ObservedTrials
from crkr.learner.outcome_scales import GOAL_SHARE
from crkr.protocol import Array

D, P = 3, 4


def observed(X: Array, Y: Array) -> ObservedTrials:
    seen = ~np.isnan(Y)
    members = tuple(None if column.all() else np.flatnonzero(column) for column in seen.T)
    return ObservedTrials(X, (X * X).sum(axis=1), Y, members)


def scattered(count: int, seed: int = 0) -> tuple[ObservedTrials, Array]:
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(count, D + P))
    return observed(X, np.stack([np.sin(X[:, 0]) + X[:, 5], X[:, 1] * X[:, 4]], axis=1)), rng.normal(size=D + P) * 0.2


def weights(X: Array, x: Array) -> tuple[Array, float]:
    distance = np.linalg.norm(X - x, axis=1)
    biweight = (1 - (distance / distance.max()) ** 2) ** 2
    return biweight * biweight.sum() / (biweight**2).sum(), float(distance.max())


def test_the_line_is_that_of_scikit_learns_weighted_ridge() -> None:
    trials, x = scattered(60)
    fit = fit_locally(trials, np.arange(60), np.array([0, 1]), x, P)
    w, reach = weights(trials.X, x)
    theirs = Ridge(alpha=RIDGE).fit((trials.X - x) / reach, trials.Y, sample_weight=w)
    np.testing.assert_allclose(fit.o, theirs.intercept_, rtol=1e-7)
    np.testing.assert_allclose(fit.J, theirs.coef_[:, D:] / reach * GOAL_SHARE, rtol=1e-7)
    there, _ = fit.at(np.array([0.3, -0.2, 0.1, 0.4]))
    moved = np.concatenate([np.zeros(D), np.array([0.3, -0.2, 0.1, 0.4]) * GOAL_SHARE]) / reach
    np.testing.assert_allclose(there, theirs.predict(moved[None])[0], rtol=1e-7)


def test_residual_variance_and_leverage_are_those_of_the_dense_formulas() -> None:
    trials, x = scattered(40, 1)
    fit = fit_locally(trials, np.arange(40), np.array([0, 1]), x, P)
    w, reach = weights(trials.X, x)
    F = np.column_stack([np.ones(40), (trials.X - x) / reach])
    inverse = np.linalg.inv(F.T @ np.diag(w) @ F + np.diag([0.0] + [RIDGE] * (D + P)))
    hat = F @ inverse @ F.T @ np.diag(w)
    residuals = trials.Y - hat @ trials.Y
    expected = (w @ residuals**2) / (w @ (1 - np.diag(hat)))
    np.testing.assert_allclose(fit.variance, expected, rtol=1e-6)
    assert fit.leverage == pytest.approx(inverse[0, 0])
    step = np.array([0.5, 0.0, -0.5, 0.2])
    f = np.concatenate([[1.0], np.zeros(D), step * GOAL_SHARE / reach])
    np.testing.assert_allclose(fit.at(step)[1], np.sqrt(expected * (1 + f @ inverse @ f)), rtol=1e-6)


def test_a_world_that_is_a_line_is_found_exactly() -> None:
    rng = np.random.default_rng(2)
    X, slope = rng.normal(size=(60, D + P)), rng.normal(size=(D + P, 1))
    trials, x = observed(X, X @ slope + 0.7), rng.normal(size=D + P)
    fit = fit_locally(trials, np.arange(60), np.array([0]), x, P, ridge=1e-13)
    np.testing.assert_allclose(fit.o, x @ slope + 0.7, atol=1e-8)
    np.testing.assert_allclose(fit.J[0], slope[D:, 0] * GOAL_SHARE, atol=1e-9)
    assert fit.variance[0] < 1e-16
    np.testing.assert_allclose(fit.at(np.ones(P))[0], (x @ slope + 0.7) + slope[D:].sum() * GOAL_SHARE, atol=1e-8)


@pytest.mark.parametrize("count", [1, 2, 200])
def test_trials_that_all_coincide_give_their_mean_and_no_slope(count: int) -> None:
    X = np.ones((count, D + P))
    Y = np.arange(count, dtype=np.float64)[:, None]
    at_home = fit_locally(observed(X, Y), np.arange(count), np.array([0]), X[0], P)
    np.testing.assert_allclose(at_home.o, Y.mean(), atol=1e-6)
    assert not at_home.J.any()
    away = fit_locally(observed(X, Y), np.arange(count), np.array([0]), X[0] + 1.0, P)
    for fit in (at_home, away):
        assert all(np.isfinite(part).all() for part in (fit.o, fit.J, fit.variance, *fit.at(np.ones(P))))


def test_neighbours_are_the_nearest_that_saw_the_group() -> None:
    trials, x = scattered(500, 3)
    Y = trials.Y.copy()
    Y[np.random.default_rng(4).uniform(size=500) < 0.6, 1] = np.nan
    trials = observed(trials.X, Y)
    distances = trials.norms - 2 * trials.X @ x
    true = ((trials.X - x) ** 2).sum(axis=1)
    assert set(nearest(trials, distances, 0, 60)) == set(np.argsort(true)[:60])
    seen = np.flatnonzero(~np.isnan(Y[:, 1]))
    assert set(nearest(trials, distances, 1, 60)) == set(seen[np.argsort(true[seen])[:60]])
    assert len(nearest(trials, distances, 1, 400)) == len(seen)


def test_the_line_moves_without_a_jump_where_neighbours_change() -> None:
    trials, x = scattered(300, 5)
    target = x + np.random.default_rng(6).normal(size=D + P) * 0.3
    previous: LocalFit | None = None
    sets = set()
    for share in np.linspace(0, 1, 2001):
        here = x + share * (target - x)
        rows = nearest(trials, trials.norms - 2 * trials.X @ here, 0, 60)
        sets.add(frozenset(rows.tolist()))
        fit = fit_locally(trials, rows, np.array([0, 1]), here, P)
        if previous is not None:
            assert np.abs(fit.o - previous.o).max() < 0.02
        previous = fit
    assert len(sets) > 10
