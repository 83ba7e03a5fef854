"""The local line beside scikit-learn's, beside dense algebra, and beside a world that is a line."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.linear_model import Ridge

from crkr.learner import Kernel
from crkr.learner.exploration.outcome_fit import RIDGE, LocalFit, fit_locally
from crkr.learner.exploration.outcome_index import ObservedTrials, in_single_precision
from crkr.learner.exploration.outcome_neighbours import nearest
from crkr.learner.exploration.outcome_posterior import linearise
from crkr.learner.exploration.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.protocol import Array

D, P = 3, 4
UNITS = OutcomeScales(  # of which only the sizes and the groups matter here
    Kernel(np.zeros(D), np.ones(D), 1.0),
    *(np.zeros(P), np.ones(P), np.full(P, -9.0), np.full(P, 9.0), np.zeros(2), np.ones(2)),
    groups=(np.array([0]), np.array([1])),
)


def observed(X: Array, Y: Array) -> ObservedTrials:
    """Trials each entry of whose outcome is a group of its own."""
    single, fits = in_single_precision(X)
    hidden = [np.where(np.isnan(column), np.inf, 0).astype(np.float32) for column in Y.T]
    return ObservedTrials.of(X.copy(), single, fits, Y.copy(), hidden)


def line_through(
    trials: ObservedTrials, x: Array, count: int, entries: tuple[int, ...] = (0, 1), ridge: float = RIDGE
) -> LocalFit:
    """The line through the `count` trials nearest to one point; the entries share the first one's trials."""
    near = nearest(trials, x[None], [entries[0]], count)
    return fit_locally(near, [trials.Y[near.rows[0]][..., list(entries)]], P, ridge)


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
    fit = line_through(trials, x, 60)
    w, reach = weights(trials.X, x)
    theirs = Ridge(alpha=RIDGE).fit((trials.X - x) / reach, trials.Y, sample_weight=w)
    np.testing.assert_allclose(fit.o[0], theirs.intercept_, rtol=1e-7)
    np.testing.assert_allclose(fit.J[0], theirs.coef_[:, D:] / reach * GOAL_SHARE, rtol=1e-7)
    there, _ = fit.at(np.array([[0.3, -0.2, 0.1, 0.4]]))
    moved = np.concatenate([np.zeros(D), np.array([0.3, -0.2, 0.1, 0.4]) * GOAL_SHARE]) / reach
    np.testing.assert_allclose(there[0], theirs.predict(moved[None])[0], rtol=1e-7)


def test_residual_variance_and_leverage_are_those_of_the_dense_formulas() -> None:
    trials, x = scattered(40, 1)
    fit = line_through(trials, x, 40)
    w, reach = weights(trials.X, x)
    F = np.column_stack([np.ones(40), (trials.X - x) / reach])
    inverse = np.linalg.inv(F.T @ np.diag(w) @ F + np.diag([0.0] + [RIDGE] * (D + P)))
    hat = F @ inverse @ F.T @ np.diag(w)
    residuals = trials.Y - hat @ trials.Y
    expected = (w @ residuals**2) / (w @ (1 - np.diag(hat)))
    np.testing.assert_allclose(fit.variance[0], expected, rtol=1e-6)
    np.testing.assert_allclose(fit.leverage, inverse[0, 0])
    step = np.array([0.5, 0.0, -0.5, 0.2])
    f = np.concatenate([[1.0], np.zeros(D), step * GOAL_SHARE / reach])
    np.testing.assert_allclose(fit.at(step[None])[1][0], np.sqrt(expected * (1 + f @ inverse @ f)), rtol=1e-6)


def test_a_world_that_is_a_line_is_found_exactly() -> None:
    rng = np.random.default_rng(2)
    X, slope = rng.normal(size=(60, D + P)), rng.normal(size=(D + P, 1))
    trials, x = observed(X, X @ slope + 0.7), rng.normal(size=D + P)
    fit = line_through(trials, x, 60, (0,), 1e-13)
    np.testing.assert_allclose(fit.o[0], x @ slope + 0.7, atol=1e-8)
    np.testing.assert_allclose(fit.J[0, 0], slope[D:, 0] * GOAL_SHARE, atol=1e-9)
    assert fit.variance[0, 0] < 1e-16
    np.testing.assert_allclose(
        fit.at(np.ones((1, P)))[0][0], (x @ slope + 0.7) + slope[D:].sum() * GOAL_SHARE, atol=1e-8
    )


@pytest.mark.parametrize("count", [1, 2, 200])
def test_trials_that_all_coincide_give_their_mean_and_no_slope(count: int) -> None:
    X = np.ones((count, D + P))
    Y = np.arange(count, dtype=np.float64)[:, None]
    at_home = line_through(observed(X, Y), X[0], count, (0,))
    np.testing.assert_allclose(at_home.o, Y.mean(), atol=1e-6)
    assert not at_home.J.any()
    away = line_through(observed(X, Y), X[0] + 1.0, count, (0,))
    for fit in (at_home, away):
        assert all(np.isfinite(part).all() for part in (fit.o, fit.J, fit.variance, *fit.at(np.ones((1, P)))))


def test_the_line_moves_without_a_jump_where_neighbours_change() -> None:
    trials, x = scattered(300, 5)
    target = x + np.random.default_rng(6).normal(size=D + P) * 0.3
    previous: LocalFit | None = None
    sets = set()
    for share in np.linspace(0, 1, 2001):
        here = x + share * (target - x)
        sets.add(frozenset(nearest(trials, here[None], [0], 60).rows[0, 0].tolist()))
        fit = line_through(trials, here, 60)
        if previous is not None:
            assert np.abs(fit.o - previous.o).max() < 0.02
        previous = fit
    assert len(sets) > 10


@pytest.mark.parametrize("seen", [1.0, 0.5, 0.05])
def test_many_lines_at_once_are_those_one_by_one(seen: float) -> None:
    trials, _ = scattered(700, 7)
    Y = trials.Y.copy()
    Y[np.random.default_rng(8).uniform(size=700) >= seen, 1] = np.nan
    trials, x = observed(trials.X, Y), np.random.default_rng(9).normal(size=(40, D + P))
    steps = np.random.default_rng(10).normal(size=(40, P))
    together = linearise(trials, UNITS, (0, 1), x, 60)
    outcomes, deviations = together.at(together.where + steps)
    for place in range(40):
        one = linearise(trials, UNITS, (0, 1), x[place : place + 1], 60)
        for whole, part in zip(together.of(np.array([place])).at(one.where), one.at(one.where), strict=True):
            assert whole.tobytes() == part.tobytes()
        for entry in (0, 1):
            o, sd = plainly(trials, x[place], entry, 60, steps[place])
            column = together.entries.tolist().index(entry)
            np.testing.assert_allclose(outcomes[place, column], o, rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(deviations[place, column], sd, rtol=1e-9)


def plainly(trials: ObservedTrials, x: Array, entry: int, count: int, step: Array) -> tuple[float, float]:
    """One entry's outcome and deviation a step from x, from a list of distances and a least-squares solver."""
    rows = np.flatnonzero(~np.isnan(trials.Y[:, entry]))
    rows = rows[np.argsort(np.linalg.norm(trials.X[rows] - x, axis=1))[:count]]
    w, reach = weights(trials.X[rows], x)
    F = np.column_stack([np.ones(len(rows)), (trials.X[rows] - x) / reach])
    root = np.sqrt(w)
    penalty = np.diag([1e-5] + [RIDGE**0.5] * (D + P))
    stacked = np.concatenate([root[:, None] * F, penalty])
    wanted = np.concatenate([root * trials.Y[rows, entry], np.zeros(D + P + 1)])
    beta = np.linalg.lstsq(stacked, wanted, rcond=None)[0]
    inverse = np.linalg.inv(stacked.T @ stacked)
    pull = w * np.einsum("ki,ij,kj->k", F, inverse, F)
    variance = (w @ (trials.Y[rows, entry] - F @ beta) ** 2) / (w @ (1 - pull))
    f = np.concatenate([[1.0], np.zeros(D), step * GOAL_SHARE / reach])
    return float(f @ beta), float(np.sqrt(variance * (1 + f @ inverse @ f)))
