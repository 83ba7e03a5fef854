"""Conditioning beside the normal equations of the same least-squares problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from crkr.learner.exploration.outcome_posterior import OutcomeLine, condition
from crkr.protocol import Array

P, M = 5, 3


def a_line(seed: int = 0) -> OutcomeLine:
    rng = np.random.default_rng(seed)
    o, J, R = rng.normal(size=(1, M)), rng.normal(size=(1, M, P)), rng.uniform(1.1, 4, (1, M))
    return OutcomeLine(rng.normal(size=(1, P)), o, J, R)


def normal_equations(mean: Array, spread: Array, line: OutcomeLine) -> tuple[Array, Array]:
    """Mean and covariance that minimise the squared steps from the mean and from the target, each in its variance."""
    where, o, J, R = line.where[0], line.o[0], line.J[0], line.R[0]
    precision = np.diag(spread**-2.0) + J.T @ np.diag(1 / R) @ J
    wanted = mean / spread**2 + J.T @ ((J @ where - o) / R)
    return np.linalg.solve(precision, wanted), np.linalg.inv(precision)


def test_the_conditioned_mean_is_the_least_squares_solution() -> None:
    rng = np.random.default_rng(1)
    mean, spread, line = rng.normal(size=P), rng.uniform(0.2, 3, P), a_line()
    expected, _ = normal_equations(mean, spread, line)
    np.testing.assert_allclose(condition(mean[None], spread[None], line).g[0], expected, rtol=1e-10)


def test_draws_have_the_conditioned_covariance() -> None:
    rng = np.random.default_rng(2)
    spread, line = rng.uniform(0.2, 3, P), a_line(3)
    posterior = condition(np.zeros((1, P)), spread[None], line)
    columns = posterior.deviations(np.eye(P + 3)[None])[0]  # what each of the standard normals adds
    np.testing.assert_allclose(columns.T @ columns, normal_equations(np.zeros(P), spread, line)[1], rtol=1e-10)


def test_drawn_deviations_are_as_likely_as_that_covariance_says() -> None:
    rng = np.random.default_rng(4)
    spread, line = rng.uniform(0.2, 3, P), a_line(5)
    _, covariance = normal_equations(np.zeros(P), spread, line)
    drawn = condition(np.zeros((1, P)), spread[None], line).deviations(rng.normal(size=(1, 4000, P + 3)))[0]
    squared = np.einsum("ai,ij,aj->a", drawn, np.linalg.inv(covariance), drawn)
    assert abs((squared < chi2(P).ppf(0.5)).mean() - 0.5) < 0.04


def test_a_goal_without_freedom_stays() -> None:
    spread = np.array([1.0, 0.0, 1.0, 0.0, 1.0])
    posterior = condition(np.ones((1, P)), spread[None], a_line(6))
    assert (posterior.g[0, [1, 3]] == 1.0).all()
    assert not posterior.deviations(np.ones((1, 2, P + 3)))[0][:, [1, 3]].any()


def test_what_is_sharp_hits_and_what_is_vague_stays() -> None:
    line = a_line(7)
    hitting = condition(np.zeros((1, P)), np.full((1, P), 1e6), line)
    np.testing.assert_allclose(line.o + (line.J @ (hitting.g - line.where)[..., None])[..., 0], 0.0, atol=1e-9)
    vague = replace(line, R=line.R + 1e12)
    np.testing.assert_allclose(condition(np.zeros((1, P)), np.ones((1, P)), vague).g, 0, atol=1e-9)


def test_an_entry_without_slope_and_miss_says_nothing() -> None:
    line = a_line(9)
    silent = replace(line, o=line.o * [[1, 0, 1]], J=line.J * np.array([1, 0, 1])[None, :, None])
    left = OutcomeLine(line.where, line.o[:, [0, 2]], line.J[:, [0, 2]], line.R[:, [0, 2]])
    mean, spread = np.ones((1, P)), np.full((1, P), 2.0)
    np.testing.assert_allclose(condition(mean, spread, silent).g, condition(mean, spread, left).g, rtol=1e-12)


def test_states_are_conditioned_each_on_its_own() -> None:
    rng = np.random.default_rng(8)
    lines = [a_line(seed) for seed in range(9)]
    mean, spread = rng.normal(size=(9, P)), rng.uniform(0.2, 3, (9, P))
    parts = {name: np.concatenate([getattr(line, name) for line in lines]) for name in ("where", "o", "J", "R")}
    posterior = condition(mean, spread, OutcomeLine(**parts))
    for place, line in enumerate(lines):
        alone = condition(mean[place : place + 1], spread[place : place + 1], line)
        assert alone.g.tobytes() == posterior.g[place].tobytes()
        assert alone.G.tobytes() == posterior.of(np.array([place])).G.tobytes()
