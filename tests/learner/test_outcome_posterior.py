"""Conditioning beside the normal equations of the same least-squares problem."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from crkr.learner.outcome_fit import LocalFit
from crkr.learner.outcome_posterior import OutcomeLine, condition
from crkr.protocol import Array

P = 5
TWO = (np.array([0, 1]), np.array([2]))


def a_line(seed: int = 0) -> OutcomeLine:
    rng = np.random.default_rng(seed)
    fits = tuple(
        LocalFit(
            rng.normal(size=len(group)),
            rng.normal(size=(len(group), P)),
            rng.uniform(0.1, 2, len(group)),
            float(rng.uniform()),
            np.eye(1 + 2 + P),
            1.0,
        )
        for group in TWO
    )
    return OutcomeLine(rng.normal(size=P), fits, np.concatenate(TWO))


def normal_equations(mean: Array, spread: Array, line: OutcomeLine) -> tuple[Array, Array]:
    """Mean and covariance that minimise the squared steps from the mean and from the target, each in its variance."""
    J = np.concatenate([fit.J for fit in line.fits])
    o = np.concatenate([fit.o for fit in line.fits])
    R = np.concatenate([1 + fit.variance * (1 + fit.leverage) for fit in line.fits])
    precision = np.diag(spread**-2.0) + J.T @ np.diag(1 / R) @ J
    wanted = mean / spread**2 + J.T @ ((J @ line.where - o) / R)
    return np.linalg.solve(precision, wanted), np.linalg.inv(precision)


def test_the_conditioned_mean_is_the_least_squares_solution() -> None:
    rng = np.random.default_rng(1)
    mean, spread, line = rng.normal(size=P), rng.uniform(0.2, 3, P), a_line()
    expected, _ = normal_equations(mean, spread, line)
    np.testing.assert_allclose(condition(mean, spread, line).g, expected, rtol=1e-10)


def test_draws_have_the_conditioned_covariance() -> None:
    rng = np.random.default_rng(2)
    spread, line = rng.uniform(0.2, 3, P), a_line(3)
    posterior = condition(np.zeros(P), spread, line)
    columns = posterior.deviations(np.eye(P + 3))  # what each of the standard normals adds
    np.testing.assert_allclose(columns.T @ columns, normal_equations(np.zeros(P), spread, line)[1], rtol=1e-10)


def test_drawn_deviations_are_as_likely_as_that_covariance_says() -> None:
    rng = np.random.default_rng(4)
    spread, line = rng.uniform(0.2, 3, P), a_line(5)
    _, covariance = normal_equations(np.zeros(P), spread, line)
    drawn = condition(np.zeros(P), spread, line).deviations(rng.normal(size=(4000, P + 3)))
    squared = np.einsum("ai,ij,aj->a", drawn, np.linalg.inv(covariance), drawn)
    assert abs((squared < chi2(P).ppf(0.5)).mean() - 0.5) < 0.04


def test_a_goal_without_freedom_stays() -> None:
    spread = np.array([1.0, 0.0, 1.0, 0.0, 1.0])
    posterior = condition(np.ones(P), spread, a_line(6))
    assert (posterior.g[[1, 3]] == 1.0).all()
    assert not posterior.deviations(np.ones((2, P + 3)))[:, [1, 3]].any()


def test_what_is_sharp_hits_and_what_is_vague_stays() -> None:
    line = a_line(7)
    exact = tuple(LocalFit(fit.o, fit.J, fit.variance * 0, 0.0, fit.L, 1.0) for fit in line.fits)
    sharp = OutcomeLine(line.where, exact, line.entries)
    hitting = condition(np.zeros(P), np.full(P, 1e6), sharp)
    o, _ = sharp.at(hitting.g)
    np.testing.assert_allclose(o, 0.0, atol=1e-9)
    vague = tuple(LocalFit(fit.o, fit.J, fit.variance + 1e12, 0.0, fit.L, 1.0) for fit in line.fits)
    np.testing.assert_allclose(
        condition(np.zeros(P), np.ones(P), OutcomeLine(line.where, vague, line.entries)).g, 0, atol=1e-9
    )
