"""Approximations of the regression, against plain algebra and against the learner; and what a trial costs."""

import numpy as np
import pytest

from crkr.experiments.study.approximators import APPROXIMATORS, Way
from crkr.experiments.study.costs import AppendedRows, trial_costs
from crkr.learner import Kernel, Regression
from crkr.sim_worker.randomness import demonstration_rng
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

Problem = tuple[Kernel, np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture
def problem() -> Problem:
    """A kernel, 40 states, their goals and noise variances."""
    rng = np.random.default_rng(1)
    kernel = Kernel(np.zeros(3), np.ones(3), 2.0)
    return kernel, rng.uniform(-2, 2, (40, 3)), rng.normal(size=(40, 4)), rng.uniform(0.01, 1.0, 40)


def test_dtc_is_the_formula_of_its_paper(problem: Problem) -> None:
    kernel, Z, Y, N = problem
    u, z = np.arange(0, 40, 4), np.random.default_rng(2).uniform(-2, 2, (5, 3))
    means, variances = APPROXIMATORS["all-by-dtc"](kernel, Z, Y, N, u)(z)
    inner, cross, query = kernel.matrix(Z[u], Z[u]), kernel.matrix(Z[u], Z), kernel.matrix(z, Z[u])
    sigma = np.linalg.inv(inner + cross / N @ cross.T)
    np.testing.assert_allclose(means, query @ sigma @ (cross / N) @ Y, rtol=1e-5, atol=1e-6)
    expected = 2.0 - np.diag(query @ np.linalg.inv(inner) @ query.T) + np.diag(query @ sigma @ query.T)
    np.testing.assert_allclose(variances, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ["all-by-dtc", "all-by-nearest", "anms-by-nearest", "anms-by-scikit-learn"])
def test_an_approximation_that_sees_every_sample_is_exact(name: str, problem: Problem) -> None:
    kernel, Z, Y, N = problem
    z = np.random.default_rng(2).uniform(-2, 2, (5, 3))
    means, variances = APPROXIMATORS[name](kernel, Z, Y, N, np.arange(40))(z)
    expected, deviation, _ = Regression.fit(kernel, Z, Y, N).over(z)
    np.testing.assert_allclose(means, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(variances, deviation, rtol=1e-5, atol=1e-6)


def test_appended_rows_are_the_regression_made_anew(problem: Problem) -> None:
    kernel, Z, Y, N = problem
    rows = AppendedRows(kernel, 40, 4)
    for z, y, noise in zip(Z, Y, N, strict=True):
        rows.append(z, y, noise)
    mean, variance = rows.at(np.full(3, 0.3))
    expected, deviation, _ = Regression.fit(kernel, Z, Y, N).at(np.full(3, 0.3))
    np.testing.assert_allclose(mean, expected, rtol=1e-9)
    assert variance == pytest.approx(deviation, rel=1e-9)


def test_scikit_learn_explores_and_answers_as_the_learner_does() -> None:
    skill = TableTennis(SkillOptions(environment="analytic", preset="paper"), traces=False)
    spec, rng = skill.spec(), np.random.default_rng(0)
    ways = [Way(rule, 8, 0.5)(spec, 3) for rule in ("anms", "anms-by-scikit-learn")]
    for way in ways:
        way.start(skill.demonstrations(5, demonstration_rng(3)))
    for _ in range(15):
        state = skill.reset(rng)
        ours, theirs = (way.ask(state) for way in ways)
        np.testing.assert_allclose(theirs, ours, rtol=1e-6, atol=1e-6)
        result = skill.execute(ours)
        for way in ways:
            way.tell(state, ours, result)
    states = np.array([skill.reset(rng) for _ in range(4)])
    np.testing.assert_allclose(ways[1].policy(states), ways[0].policy(states), rtol=1e-6, atol=1e-6)


def test_the_cost_of_a_trial_is_told_of_every_way() -> None:
    ways = {name: Way(name, 8, 1.0) for name in ("anms", "recency", "all-by-dtc")}
    found = trial_costs(ways, 20, rounds=2)
    assert list(found) == [*ways, "full, rows appended at best"]
    assert all(milliseconds > 0 for milliseconds in found.values())
