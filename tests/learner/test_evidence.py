from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from crkr.learner import FitProblem, Kernel, Model, Parameters, fit, log_evidence
from crkr.protocol import Array, TaskSpec


def problem(seed: int, m: int = 40, d: int = 3, p: int = 2, linear: float = 0.0) -> FitProblem:
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, (m, d))
    costs = rng.uniform(0.2, 1, m)  # above the floor at every signal variance tried: at the floor itself is a kink
    costs[:4] = 0.0  # these stand below it
    Y = np.sin(X @ rng.normal(size=(d, p))) + 0.1 * rng.normal(size=(m, p))
    return FitProblem(X, Y, 0.3 * costs, 1e-2, np.full(d, 1.2), 0.8, linear, np.ones(d))


def test_evidence_is_the_density_of_the_goals() -> None:
    given_problem = problem(0, m=12)
    Z = given_problem.X / given_problem.lengthscales
    K = 0.8 * np.exp(-0.5 * np.sum((Z[:, None] - Z[None]) ** 2, axis=-1))
    K += np.diag(np.maximum(given_problem.noise, 1e-2 * 0.8))
    expected = sum(multivariate_normal(np.zeros(12), K).logpdf(column) for column in given_problem.Y.T)
    theta = np.log(np.append(given_problem.lengthscales, 0.8))
    assert log_evidence(given_problem, theta)[0] == pytest.approx(expected, rel=1e-10)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(1, 13), st.sampled_from([0.0, 0.5]))
def test_gradient_equals_finite_differences(seed: int, d: int, p: int, linear: float) -> None:
    given_problem = problem(seed, 30, d, p, linear)
    theta = np.random.default_rng(seed).uniform(-0.5, 0.8, d + 1)
    _, gradient = log_evidence(given_problem, theta)
    step = 1e-3
    for index, partial in enumerate(gradient):
        along = np.zeros(d + 1)
        along[index] = step
        # Five points: the error of the difference is of order step^4.
        values = [log_evidence(given_problem, theta + shift * along)[0] for shift in (-2, -1, 1, 2)]
        difference = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
        assert abs(difference - partial) <= 1e-6 * max(np.abs(gradient).max(), 1.0)


def test_a_fit_finds_the_length_scales_that_made_the_data() -> None:
    rng = np.random.default_rng(3)
    X = rng.uniform(-2, 2, (200, 2))
    Z = X / np.array([0.5, 3.0])
    K = np.exp(-0.5 * np.sum((Z[:, None] - Z[None]) ** 2, axis=-1)) + 1e-2 * np.eye(200)
    Y = np.linalg.cholesky(K) @ rng.normal(size=(200, 8))
    found = fit(FitProblem(X, Y, np.full(200, 1e-2), 1e-4, np.ones(2), 1.0, 0.0, np.ones(2)))
    assert found.accepted
    assert found.after > found.before
    np.testing.assert_allclose(found.lengthscales, [0.5, 3.0], rtol=0.15)
    assert found.signal_variance == pytest.approx(1.0, rel=0.3)


def test_a_warm_start_at_the_optimum_is_not_accepted_twice() -> None:
    start = problem(5, 60)
    first = fit(start)
    again = fit(replace(start, lengthscales=first.lengthscales, signal_variance=first.signal_variance))
    assert first.accepted
    assert again.after == pytest.approx(first.after, abs=0.05)
    assert again.after >= again.before


def test_a_fit_stays_within_its_bounds_and_is_repeatable() -> None:
    start = problem(6, 8, 4, 1)
    first, second = fit(start), fit(start)
    np.testing.assert_array_equal(first.lengthscales, second.lengthscales)
    assert (first.lengthscales >= 0.05 * (1 - 1e-9)).all()
    assert (first.lengthscales <= 20 * (1 + 1e-9)).all()


def test_a_fit_in_another_process_finds_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")  # as here: the number of threads changes the last bits
    start = problem(7)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        elsewhere = pool.submit(fit, start).result(timeout=60)
    here = fit(start)
    np.testing.assert_array_equal(elsewhere.lengthscales, here.lengthscales)
    assert elsewhere.after == here.after


def model_of(states: Array, lengthscale: float = 1.0) -> Model:
    kernel = Kernel(np.zeros(1), np.array([lengthscale]), 1.0)
    axis = {"name": "x", "low": -2.0, "high": 2.0}
    spec = TaskSpec.from_dict({"name": "fitted", "state": [axis], "goal": [axis]})
    parameters = Parameters.create(spec, kernel, np.zeros(1))
    ids = [UUID(int=number) for number in range(len(states))]
    goals = np.sin(3.0 * np.clip(states, -2, 2)) / 2
    return Model.create(7, parameters, ids, states.copy(), goals, np.full(len(states), 0.1))


@pytest.mark.parametrize("absurd", [1e12, 1e154, 1e300])
def test_a_state_that_is_absurdly_far_away_does_not_keep_a_fit_from_the_others(absurd: float) -> None:
    states = np.random.default_rng(0).uniform(-2, 2, (40, 1))
    usual = fit(FitProblem.of(model_of(states), np.ones(1)))
    beside = fit(FitProblem.of(model_of(np.concatenate([states, [[absurd], [-absurd]]])), np.ones(1)))
    assert usual.accepted
    assert beside.lengthscales == pytest.approx(usual.lengthscales)


def test_a_fit_of_very_long_length_scales_stays_a_number() -> None:
    states = np.random.default_rng(1).uniform(0, 1e300, (40, 1))
    found = fit(FitProblem.of(model_of(states, 1e299), np.array([1e299])))
    assert np.isfinite(found.lengthscales).all()


def test_a_fit_of_a_large_model_looks_at_some_of_its_samples() -> None:
    states = np.linspace(-2, 2, 1600)[:, None]
    problem = FitProblem.of(model_of(states), np.ones(1))
    assert len(problem.X) == len(problem.Y) == len(problem.noise) == 1500
    assert (problem.X[0], problem.X[-1]) == (-2.0, 2.0)
