"""Rivals that learn a policy from costs alone: regression on successes, and two kinds of contextual policy search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, final

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from crkr.experiments.rivals.rival import TaskScales, cost_of
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["LinearGaussianSearch", "SuccessRegression", "contextual_cma_es", "contextual_reps"]

BATCH: Final = 40  # trials; fewer are not enough for 13 times 7 gains
EPSILON: Final = 0.5  # bound of the relative entropy of a step
NEWEST: Final = 400  # successes of a regression, which takes cubic time


@final
class SuccessRegression:
    """scikit-learn's Gaussian process from states to the goals of successes, explored by its own deviation."""

    def __init__(self, spec: TaskSpec, seed: int) -> None:
        self._spec, self._rng = spec, np.random.default_rng(seed)
        self._states: list[Array] = []
        self._goals: list[Array] = []

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """The first successes."""
        self._scales = TaskScales(self._spec, demonstrations)
        for shown in demonstrations:
            self.tell(shown.state, shown.goal, shown.result)

    def ask(self, state: Array) -> Array:
        """A draw of the posterior, at least a tenth of a scale wide."""
        mean, deviation = self._predict(state[None, :])
        noise = np.maximum(deviation[0], 0.1) * self._rng.standard_normal(mean.shape[1])
        return self._scales.real_goals(mean[0] + noise)

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Keeps successes."""
        if result.success and result.executed:
            self._states.append(self._scales.states(state))
            self._goals.append(self._scales.goals(goal))
            self._model: GaussianProcessRegressor | None = None

    def policy(self, states: Array) -> Array:
        """The posterior's mean."""
        return self._scales.real_goals(self._predict(states)[0])

    def _predict(self, states: Array) -> tuple[Array, Array]:
        if not self._goals:
            shape = len(states), len(self._spec.goal)
            return np.zeros(shape), np.ones(shape)
        if self._model is None:
            kernel = ConstantKernel(1.0) * RBF(np.ones(len(self._spec.state))) + WhiteKernel(0.1)
            self._model = GaussianProcessRegressor(kernel, optimizer=None)
            self._model.fit(np.array(self._states[-NEWEST:]), np.array(self._goals[-NEWEST:]))
        mean, deviation = self._model.predict(self._scales.states(states), return_std=True)
        return np.asarray(mean), np.asarray(deviation)


@final
class LinearGaussianSearch:
    """Policy search: a policy that is linear in (1, state) with Gaussian noise, improved after every batch of trials.

    Args:
        spec: The task.
        seed: Of the draws that explore.
        improve: Changes the policy by features (n, d + 1), scaled goals (n, p) and costs (n,) of a batch.
        deviation: Of the first noise, in scales of the goal.

    Attributes:
        gain: (d + 1, p) features to scaled goals.
        covariance: (p, p) of the noise.
    """

    def __init__(self, spec: TaskSpec, seed: int, improve: Improvement, deviation: float) -> None:
        self._spec, self._rng, self._improve, self._deviation = spec, np.random.default_rng(seed), improve, deviation
        self._trials: list[tuple[Array, Array, float]] = []

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """A ridge regression of the demonstrations, and noise."""
        self._scales = TaskScales(self._spec, demonstrations)
        features = np.array([self._features(shown.state) for shown in demonstrations])
        goals = np.array([self._scales.goals(shown.goal) for shown in demonstrations])
        ridge = np.eye(features.shape[1])
        ridge[0, 0] = 1e-9
        self.gain: Array = np.linalg.solve(features.T @ features + ridge, features.T @ goals)
        self.covariance: Array = np.eye(goals.shape[1]) * self._deviation**2

    def ask(self, state: Array) -> Array:
        """A draw of the policy."""
        noise = np.linalg.cholesky(self.covariance) @ self._rng.standard_normal(len(self.covariance))
        return self._scales.real_goals(self._features(state) @ self.gain + noise)

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Improves the policy when a batch is full."""
        self._trials.append((self._features(state), self._scales.goals(goal), cost_of(result)))
        if len(self._trials) == BATCH:
            features, goals, costs = (np.array(part) for part in zip(*self._trials, strict=True))
            self._trials.clear()
            self._improve(self, features, goals, costs)

    def policy(self, states: Array) -> Array:
        """The policy's mean."""
        return self._scales.real_goals(self._features(states) @ self.gain)

    def fit(self, features: Array, goals: Array, weights: Array, old: float) -> None:
        """Moves the gain by weighted regression, with the old gain as a prior of weight `old`."""
        prior = old * np.eye(features.shape[1])
        normal = features.T @ (weights[:, None] * features) + prior
        moved = np.linalg.solve(normal, features.T @ (weights[:, None] * goals) + prior @ self.gain)
        self.gain = np.asarray(moved, np.float64)

    def _features(self, states: Array) -> Array:
        scaled = self._scales.states(states)
        return np.concatenate([np.ones((*scaled.shape[:-1], 1)), scaled], axis=-1)


Improvement = Callable[[LinearGaussianSearch, Array, Array, Array], None]


def _reps_step(search: LinearGaussianSearch, features: Array, goals: Array, costs: Array) -> None:
    baseline = features @ np.linalg.lstsq(features, -costs, rcond=None)[0]
    advantages = -costs - baseline

    def dual(log_eta: float) -> float:
        eta = np.exp(log_eta)
        return float(eta * EPSILON + eta * (logsumexp(advantages / eta) - np.log(len(costs))))

    eta = np.exp(minimize_scalar(dual, bounds=(-7.0, 5.0), method="bounded").x)
    weights = np.exp((advantages - advantages.max()) / eta)
    weights /= weights.sum()
    search.fit(features, goals, weights, old=1e-2)
    off = goals - features @ search.gain
    size = len(search.covariance)
    effective = 1 / (weights**2).sum()
    share = effective / (effective + size)  # few effective trials do not determine a covariance
    widened = share * (off.T * weights) @ off + (1 - share) * search.covariance + 1e-6 * np.eye(size)
    search.covariance = np.asarray(widened, np.float64)


def contextual_reps(spec: TaskSpec, seed: int) -> LinearGaussianSearch:
    """Contextual relative entropy policy search, with a baseline linear in the state  [Kupcsik2013]."""
    return LinearGaussianSearch(spec, seed, _reps_step, deviation=1 / 3)


def _cma_step(search: LinearGaussianSearch, features: Array, goals: Array, costs: Array) -> None:
    best = np.argsort(costs)[: len(costs) // 2]
    weights = np.zeros(len(costs))
    weights[best] = np.log(len(best) + 0.5) - np.log(np.arange(1, len(best) + 1))
    weights /= weights.sum()
    off = goals - features @ search.gain  # from the old policy
    search.fit(features, goals, weights, old=0.3)
    size, effective = len(search.covariance), 1 / (weights**2).sum()
    rate = min(1.0, 2 * effective / ((size + 2) ** 2 + effective))
    search.covariance = np.asarray((1 - rate) * search.covariance + rate * (off.T * weights) @ off, np.float64)


def contextual_cma_es(spec: TaskSpec, seed: int) -> LinearGaussianSearch:
    """Contextual CMA-ES: rank-mu update of a linear policy's gain and covariance  [Abdolmaleki2017].

    The trials of a batch are ranked by their costs alone, whatever their states.
    """
    return LinearGaussianSearch(spec, seed, _cma_step, deviation=0.1)
