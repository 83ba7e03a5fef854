from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

from crkr.learner import Kernel, Regression, noise_variances
from crkr.protocol import Array, Internal

Problem = tuple[np.random.Generator, Kernel, Array, Array, Array]  # and states, goals, costs


def problem(seed: int, m: int, d: int, p: int, variance: float = 1.0, linear: float = 0.0) -> Problem:
    rng = np.random.default_rng(seed)
    kernel = Kernel(rng.normal(size=d), rng.uniform(0.3, 3.0, d), variance, linear)
    states, goals = rng.normal(size=(m, d)), rng.normal(size=(m, p))
    costs = rng.uniform(1e-3, 1.0, m)
    return rng, kernel, states, goals, costs


def assert_close(ours: Array, theirs: Array) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    m=st.integers(1, 500),
    d=st.integers(1, 6),
    p=st.integers(1, 13),
    variance=st.floats(0.1, 10.0),
    regularisation=st.floats(0.1, 10.0),
)
def test_mean_and_sigma_equal_those_of_scikit_learn(
    seed: int, m: int, d: int, p: int, variance: float, regularisation: float
) -> None:
    rng, kernel, states, goals, costs = problem(seed, m, d, p, variance)
    noise = noise_variances(costs, regularisation, "linear", 1e-4 * variance)
    queries = rng.normal(size=(20, d))
    theirs = GaussianProcessRegressor(
        ConstantKernel(variance) * RBF(kernel.lengthscales),
        alpha=np.maximum(regularisation * costs, 1e-4 * variance),
        optimizer=None,
    )
    means, sigmas = theirs.fit(states, goals).predict(queries, return_std=True)
    ours = Regression.fit(kernel, kernel.standardise(states), goals.copy(), noise)
    batch_means, batch_variances, _ = ours.over(kernel.standardise(queries))
    assert_close(batch_means, means.reshape(20, p))
    assert_close(np.sqrt(batch_variances), sigmas.reshape(20, p)[:, 0])
    for query, mean, sigma in zip(queries, means.reshape(20, p), sigmas.reshape(20, p), strict=True):
        one_mean, one_variance, _ = ours.at(kernel.standardise(query))
        assert_close(one_mean, mean)
        np.testing.assert_allclose(np.sqrt(one_variance), sigma[0], rtol=1e-9)


def test_linear_term_equals_that_of_scikit_learn() -> None:
    rng, kernel, states, goals, costs = problem(1, 80, 3, 2, 1.5, 0.7)
    z, queries = kernel.standardise(states), kernel.standardise(rng.normal(size=(9, 3)))
    theirs = GaussianProcessRegressor(
        ConstantKernel(1.5) * RBF(np.ones(3)) + ConstantKernel(0.7) * DotProduct(0.0, "fixed"),
        alpha=costs,
        optimizer=None,
    )
    means, sigmas = theirs.fit(z, goals).predict(queries, return_std=True)
    ours = Regression.fit(kernel, z, goals, costs)
    batch_means, batch_variances, priors = ours.over(queries)
    assert_close(batch_means, means)
    assert_close(np.sqrt(batch_variances), sigmas[:, 0])
    np.testing.assert_allclose(priors, 1.5 + 0.7 * np.sum(queries**2, axis=1), rtol=1e-12)
    assert ours.at(queries[0])[2] == pytest.approx(priors[0], rel=1e-12)


def test_constant_noise_is_plain_gaussian_process_regression() -> None:
    rng, kernel, states, goals, _ = problem(2, 60, 2, 3)
    z, queries = kernel.standardise(states), kernel.standardise(rng.normal(size=(5, 2)))
    K = np.exp(-0.5 * np.sum((z[:, None] - z[None]) ** 2, axis=-1)) + 0.3 * np.eye(60)
    k = np.exp(-0.5 * np.sum((queries[:, None] - z[None]) ** 2, axis=-1))
    means, variances, _ = Regression.fit(kernel, z, goals, np.full(60, 0.3)).over(queries)
    assert_close(means, k @ np.linalg.solve(K, goals))
    assert_close(variances, 1.0 - np.sum(k * np.linalg.solve(K, k.T).T, axis=1))


def test_noise_grows_with_cost_and_never_falls_below_its_floor() -> None:
    costs = np.array([0.0, 1e-5, 0.5, 1.0])
    np.testing.assert_allclose(noise_variances(costs, 2.0, "linear", 1e-4), [1e-4, 1e-4, 1.0, 2.0])
    np.testing.assert_allclose(noise_variances(costs, 2.0, "odds", 1e-4), [1e-4, 1e-4, 2.0, 2.0 * (1 - 1e-6) / 1e-6])


def test_an_appended_factor_equals_a_fresh_one() -> None:
    rng, kernel, states, goals, costs = problem(3, 700, 4, 2)
    z, queries = kernel.standardise(states), kernel.standardise(rng.normal(size=(50, 4)))
    first = Regression.fit(kernel, z[:600].copy(), goals[:600], costs[:600].copy())
    appended = Regression.fit(kernel, z, goals, costs, first)
    fresh = Regression.fit(kernel, z, goals, costs)
    assert not np.array_equal(appended.L, fresh.L), "the factor was recomputed instead of extended"
    for ours, theirs in zip(appended.over(queries), fresh.over(queries), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11)


def test_a_factor_is_not_extended_when_an_earlier_sample_changed() -> None:
    _, kernel, states, goals, costs = problem(4, 600, 3, 1)
    z = kernel.standardise(states)
    first = Regression.fit(kernel, z[:550].copy(), goals[:550], costs[:550].copy())
    changed = costs.copy()
    changed[7] = 0.9
    extended = Regression.fit(kernel, z.copy(), goals, changed.copy(), first)
    np.testing.assert_array_equal(extended.L, Regression.fit(kernel, z, goals, changed).L)


def test_influence_times_goals_is_the_mean() -> None:
    _, kernel, states, goals, costs = problem(5, 40, 2, 3)
    regression = Regression.fit(kernel, kernel.standardise(states), goals, costs)
    z = kernel.standardise(np.array([0.1, -0.2]))
    np.testing.assert_allclose(regression.influence(z) @ goals, regression.at(z)[0], rtol=1e-10)


def test_a_matrix_that_does_not_factor_gets_a_higher_floor_and_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    kernel = Kernel(np.zeros(1), np.ones(1), 1.0, 1.0)
    z = np.array([[1e20], [1e20], [-1e20], [0.5]])
    regression = Regression.fit(kernel, z, np.array([[1.0], [-1.0], [0.0], [0.2]]), np.full(4, 1e-4))
    assert regression.floor > 1e-4
    assert "noise floor" in caplog.text
    assert all(np.isfinite(part).all() for part in regression.over(np.array([[0.0], [1e20], [3.0]])))


def test_a_floor_that_stays_raised_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    kernel, goals = Kernel(np.zeros(1), np.ones(1), 1.0), np.array([[1.0], [2.0], [3.0]])
    first = Regression.fit(kernel, np.zeros((2, 1)), goals[:2], np.full(2, 1e-30))
    second = Regression.fit(kernel, np.zeros((3, 1)), goals, np.full(3, 1e-30), first)
    assert min(first.floor, second.floor) > 1e-30
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_noise_that_rounds_to_nothing_beside_the_kernel_still_factors() -> None:
    kernel = Kernel(np.zeros(1), np.ones(1), 1e-310)
    regression = Regression.fit(kernel, np.zeros((2, 1)), np.array([[1.0], [2.0]]), np.zeros(2))
    assert all(np.isfinite(part).all() for part in regression.over(np.array([[0.0], [3.0]])))


def test_a_kernel_matrix_without_numbers_is_given_up() -> None:
    kernel = Kernel(np.zeros(1), np.ones(1), np.nan)
    with pytest.raises(Internal, match="does not factor"):
        Regression.fit(kernel, np.zeros((3, 1)), np.ones((3, 1)), np.full(3, 1e-4))


def test_a_state_that_is_far_away_does_not_drown_the_others_in_a_linear_term() -> None:
    kernel = Kernel(np.zeros(1), np.ones(1), 1.0, 1.0)
    near, far = np.array([[-1.0], [0.0], [1.0]]), np.array([[1e50], [1e50]])
    goals, noise = np.array([[1.0], [2.0], [3.0], [0.0], [0.1]]), np.full(5, 1e-4)
    regression = Regression.fit(kernel, np.concatenate([near, far]), goals, noise)
    means, _, _ = regression.over(near)
    np.testing.assert_allclose(means[:, 0], [1.0, 2.0, 3.0], atol=0.5)


def test_arrays_of_a_regression_are_read_only() -> None:
    _, kernel, states, goals, costs = problem(6, 20, 2, 1)
    regression = Regression.fit(kernel, kernel.standardise(states), goals, costs)
    for array in (regression.Z, regression.noise, regression.L, regression.W):
        with pytest.raises(ValueError, match="read-only"):
            array.flat[0] = 1.0


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3), st.floats(0.0, 1.0))
def test_any_finite_state_gets_a_finite_answer(state: list[float], linear: float) -> None:
    _, kernel, states, goals, costs = problem(7, 20, 3, 2, 1.0, linear)
    regression = Regression.fit(kernel, kernel.standardise(states), goals, costs)
    mean, variance, prior = regression.at(kernel.standardise(np.array(state)))
    assert np.isfinite(mean).all()
    assert 0.0 <= variance <= prior * (1 + 1e-9)
