"""Rivals that learn a policy from costs alone: regression on successes, and two kinds of contextual policy search."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Final, final

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from crkr.experiments.rivals.rival import TaskScales
from crkr.protocol import TaskSpec
from crkr.sim_worker.skill import Demonstration, Floats, TrialResult

__all__ = ["ContextualCmaEs", "ContextualReps", "SuccessRegression"]

NEWEST: Final = 400  # successes of a regression; exact ones cost the cube of their number


def _cost(result: TrialResult) -> float:
    return 1.0 if result.cost is None else float(result.cost)


@final
class SuccessRegression:
    """scikit-learn's Gaussian process from states to the goals of successes, explored by its own deviation."""

    def __init__(self, spec: TaskSpec, seed: int) -> None:
        self._spec, self._rng = spec, np.random.default_rng(seed)
        self._states: list[Floats] = []
        self._goals: list[Floats] = []

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """The first successes."""
        self._scales = TaskScales(self._spec, demonstrations)
        for shown in demonstrations:
            self.tell(shown.state, shown.goal, shown.result)

    def ask(self, state: Floats) -> Floats:
        """A draw of the posterior, at least a tenth of a scale wide."""
        mean, deviation = self._predict(state[None, :])
        noise = np.maximum(deviation[0], 0.1) * self._rng.standard_normal(mean.shape[1])
        return self._scales.real_goals(mean[0] + noise)

    def tell(self, state: Floats, goal: Floats, result: TrialResult) -> None:
        """Keeps successes."""
        if result.success and result.executed:
            self._states.append(self._scales.states(state))
            self._goals.append(self._scales.goals(goal))
            self._model: GaussianProcessRegressor | None = None

    def policy(self, states: Floats) -> Floats:
        """The posterior's mean."""
        return self._scales.real_goals(self._predict(states)[0])

    def _predict(self, states: Floats) -> tuple[Floats, Floats]:
        if self._model is None:
            kernel = ConstantKernel(1.0) * RBF(np.ones(len(self._spec.state))) + WhiteKernel(0.1)
            self._model = GaussianProcessRegressor(kernel, optimizer=None)
            self._model.fit(np.array(self._states[-NEWEST:]), np.array(self._goals[-NEWEST:]))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            mean, deviation = self._model.predict(self._scales.states(states), return_std=True)
        return np.asarray(mean), np.asarray(deviation)


class _LinearGaussian:
    """A policy that is linear in (1, state) with Gaussian noise, improved after every `batch` trials."""

    def __init__(self, spec: TaskSpec, seed: int, batch: int) -> None:
        self._spec, self._rng, self._batch = spec, np.random.default_rng(seed), batch
        self._trials: list[tuple[Floats, Floats, float]] = []

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """A ridge regression of the demonstrations, and noise of a third of a scale."""
        self._scales = TaskScales(self._spec, demonstrations)
        features = np.array([self._features(shown.state) for shown in demonstrations])
        goals = np.array([self._scales.goals(shown.goal) for shown in demonstrations])
        ridge = np.eye(features.shape[1])
        ridge[0, 0] = 1e-9
        self._gain = np.linalg.solve(features.T @ features + ridge, features.T @ goals)
        self._covariance = np.eye(goals.shape[1]) / 9

    def ask(self, state: Floats) -> Floats:
        """A draw of the policy."""
        noise = np.linalg.cholesky(self._covariance) @ self._rng.standard_normal(len(self._covariance))
        return self._scales.real_goals(self._features(state) @ self._gain + noise)

    def tell(self, state: Floats, goal: Floats, result: TrialResult) -> None:
        """Improves the policy when a batch is full."""
        self._trials.append((self._features(state), self._scales.goals(goal), _cost(result)))
        if len(self._trials) == self._batch:
            features, goals, costs = (np.array(part) for part in zip(*self._trials, strict=True))
            self._trials.clear()
            self._improve(features, goals, costs)

    def policy(self, states: Floats) -> Floats:
        """The policy's mean."""
        return self._scales.real_goals(self._features(states) @ self._gain)

    def _features(self, states: Floats) -> Floats:
        scaled = self._scales.states(states)
        return np.concatenate([np.ones((*scaled.shape[:-1], 1)), scaled], axis=-1)

    def _improve(self, features: Floats, goals: Floats, costs: Floats) -> None:
        raise NotImplementedError

    def _fit(self, features: Floats, goals: Floats, weights: Floats, old: float) -> Floats:
        """Moves the gain by weighted regression, with the old gain as a prior; gives the deviations."""
        prior = old * np.eye(features.shape[1])
        normal = features.T @ (weights[:, None] * features) + prior
        self._gain = np.linalg.solve(normal, features.T @ (weights[:, None] * goals) + prior @ self._gain)
        return np.asarray(goals - features @ self._gain)


@final
class ContextualReps(_LinearGaussian):
    """Contextual relative entropy policy search, with a baseline linear in the state  [Kupcsik2013]."""

    EPSILON: Final = 0.5  # bound of the relative entropy of a step

    def __init__(self, spec: TaskSpec, seed: int) -> None:
        super().__init__(spec, seed, batch=40)

    def _improve(self, features: Floats, goals: Floats, costs: Floats) -> None:
        baseline = features @ np.linalg.lstsq(features, -costs, rcond=None)[0]
        advantages = -costs - baseline

        def dual(log_eta: float) -> float:
            eta = np.exp(log_eta)
            return float(eta * self.EPSILON + eta * (logsumexp(advantages / eta) - np.log(len(costs))))

        eta = np.exp(minimize_scalar(dual, bounds=(-7.0, 5.0), method="bounded").x)
        weights = np.exp((advantages - advantages.max()) / eta)
        weights /= weights.sum()
        off = self._fit(features, goals, weights, old=1e-2)
        size = len(self._covariance)
        effective = 1 / (weights**2).sum()
        share = effective / (effective + size)  # few effective trials say little of a covariance
        self._covariance = share * (off.T * weights) @ off + (1 - share) * self._covariance + 1e-6 * np.eye(size)


@final
class ContextualCmaEs(_LinearGaussian):
    """Contextual CMA-ES: rank-mu update of a linear policy's gain and covariance  [Abdolmaleki2017]."""

    def __init__(self, spec: TaskSpec, seed: int) -> None:
        super().__init__(spec, seed, batch=40)  # fewer say too little of 13 times 7 gains

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """As the others, with less noise: it widens by itself."""
        super().start(demonstrations)
        self._covariance = self._covariance * 0.09

    def _improve(self, features: Floats, goals: Floats, costs: Floats) -> None:
        best = np.argsort(costs)[: len(costs) // 2]
        weights = np.zeros(len(costs))
        weights[best] = np.log(len(best) + 0.5) - np.log(np.arange(1, len(best) + 1))
        weights /= weights.sum()
        off = goals - features @ self._gain  # from the old policy, as in CMA-ES
        self._fit(features, goals, weights, old=0.3)
        size, effective = len(self._covariance), 1 / (weights**2).sum()
        rate = min(1.0, 2 * effective / ((size + 2) ** 2 + effective))
        self._covariance = (1 - rate) * self._covariance + rate * (off.T * weights) @ off
