"""Forward models: learn the outcome of a goal, then search for the goal with the predicted outcome on target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, Protocol, final

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from sklearn.linear_model import Ridge
from sklearn.preprocessing import PolynomialFeatures

from crkr.experiments.rivals.rival import TaskScales
from crkr.protocol import Array, Invalid, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["REFIT", "ForwardModel", "Surface", "SurfaceFit", "bayesian_quadratic", "ridge_quadratic"]

SurfaceFit = Callable[[Array], tuple[Array, Array]]  # x (b, n) -> outcomes (b, q) and their slopes (b, q, n)

STEPS: Final = 12  # of Gauss-Newton; further ones change a goal by less than a thousandth of its scale
DAMPING: Final = 1e-6
CLONING_RIDGE: Final = 0.1
REFIT: Final = 1.02
LONE_NOISE: Final = 0.3  # after one demonstration, which shows no slope; tuned on seeds 40 and 41


class Surface(Protocol):
    """Outcomes as smooth functions of x, a scaled state followed by a scaled goal."""

    def add(self, x: Array, y: Array) -> None:
        """Takes one trial: x (n,), y (q,), NaN where not observed."""

    def fit(self) -> SurfaceFit:
        """The functions that fit the trials so far."""


@final
class ForwardModel:
    """A model of the outcome, inverted by Gauss-Newton around a regression of successes.

    Args:
        spec: The task; it must have outcomes.
        seed: Of the noise that explores.
        surface: Makes the model's surface for a number of outcome entries and one of inputs.
        noise: Its standard deviation in scales of the goal.
        trust: Scales of a goal that count as much as one tolerance of the outcome.
    """

    def __init__(
        self, spec: TaskSpec, seed: int, surface: Callable[[int, int], Surface], *, noise: float, trust: float
    ) -> None:
        if not spec.outcome:
            raise Invalid("a forward model needs a task with outcomes")
        self._spec = spec
        self._rng = np.random.default_rng(seed)
        self._make_surface, self._noise, self._trust = surface, noise, trust
        self._successes: list[tuple[Array, Array]] = []

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Sets scales from them, and adds them as successes."""
        self._scales = TaskScales(self._spec, demonstrations)
        shape = len(self._spec.outcome), len(self._spec.state) + len(self._spec.goal)
        self._surface = self._make_surface(*shape)
        if len(demonstrations) == 1:
            self._noise = max(self._noise, LONE_NOISE)
        for shown in demonstrations:
            self.tell(shown.state, shown.goal, shown.result)

    def ask(self, state: Array) -> Array:
        """The best goal, with noise. Thompson sampling is far worse: one draw of 210 weights says nothing."""
        unit = np.array([entry.scale for entry in self._spec.goal])
        goal = self._search(state[None, :])[0] + self._noise * unit * self._rng.standard_normal(len(unit))
        return np.asarray(np.clip(goal, self._scales.low, self._scales.high))

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Adds the outcome; successes also move the centre of the search."""
        z, g = self._scales.states(state), self._scales.goals(goal)
        if result.outcome is not None:
            self._surface.add(np.concatenate([z, g]), self._scales.outcomes(result.outcome))
        if result.success and result.executed:
            self._successes.append((z, g))

    def policy(self, states: Array) -> Array:
        """The best goals by the mean of the surface."""
        return self._search(states)

    def _cloned(self, z: Array) -> Array:
        """Behaviour cloning: a ridge regression of successful goals on states; without any, the first goals' mean."""
        if not self._successes:
            return np.zeros((len(z), len(self._spec.goal)))
        inputs, goals = (np.array(part) for part in zip(*self._successes, strict=True))
        model = Ridge(CLONING_RIDGE * len(inputs)).fit(inputs, goals)
        return np.asarray(model.predict(z))

    def _search(self, states: Array) -> Array:
        """Gauss-Newton on outcome deviations in tolerances and distances from the cloned goal in trusted scales."""
        z = self._scales.states(states)
        prior = self._cloned(z)
        outcomes = self._surface.fit()
        low, high = self._scales.bounds()
        goals, d = np.clip(prior, low, high), z.shape[1]
        for _ in range(STEPS):
            y, slopes = outcomes(np.concatenate([z, goals], axis=1))
            wrong = np.where(self._scales.side == 0, True, np.sign(y) == self._scales.side)
            jacobian = slopes[:, :, d:] * wrong[:, :, None]
            residual = np.where(wrong, y, 0.0)
            normal = jacobian.transpose(0, 2, 1) @ jacobian
            normal += (self._trust**-2 + DAMPING) * np.eye(goals.shape[1])
            push = np.einsum("bqi,bq->bi", jacobian, residual) + (goals - prior) * self._trust**-2
            goals = np.clip(goals - np.linalg.solve(normal, push[:, :, None])[:, :, 0], low, high)
        return self._scales.real_goals(goals)


def _quadratic_features(x: Array) -> Array:
    """1, x and all products of two entries."""
    rows, columns = np.triu_indices(len(x))
    return np.concatenate([[1.0], x, x[rows] * x[columns]])


def _quadratic(weights: Array, size: int) -> SurfaceFit:
    """The quadratics y = c + b x + x A x of weights (q, features)."""
    rows, columns = np.triu_indices(size)
    constant, slope = weights[:, 0], weights[:, 1 : 1 + size]
    curvature = np.zeros((len(weights), size, size))
    curvature[:, rows, columns] += weights[:, 1 + size :] / 2
    curvature[:, columns, rows] += weights[:, 1 + size :] / 2

    def outcomes(x: Array) -> tuple[Array, Array]:
        bent = np.einsum("qij,bj->bqi", curvature, x)
        return constant + x @ slope.T + np.einsum("bqi,bi->bq", bent, x), slope + 2 * bent

    return outcomes


@final
class _BayesianSurface:
    """Bayesian linear regression on quadratic features; trials far from the target are noisier."""

    def __init__(self, entries: int, size: int, noise: float, linear_sd: float, quadratic_sd: float) -> None:
        self._size, self._noise = size, noise
        products = size * (size + 1) // 2
        prior = np.concatenate([[100.0], np.full(size, linear_sd), np.full(products, quadratic_sd)])
        self._precision = np.repeat(np.diag(prior**-2.0)[None], entries, axis=0)
        self._push = np.zeros((entries, len(prior)))

    def add(self, x: Array, y: Array) -> None:
        features = _quadratic_features(x)
        seen = np.isfinite(y)
        weights = 1 / (self._noise**2 * (1 + np.nansum(y**2)))
        self._precision[seen] += weights * np.outer(features, features)
        self._push[seen] += weights * np.outer(y[seen], features)

    def fit(self) -> SurfaceFit:
        weights = np.empty_like(self._push)
        for entry, (precision, push) in enumerate(zip(self._precision, self._push, strict=True)):
            weights[entry] = cho_solve(cho_factor(precision), push)
        return _quadratic(weights, self._size)


def bayesian_quadratic(spec: TaskSpec, seed: int) -> ForwardModel:
    """A global Bayesian quadratic fit of the outcome: slopes of 5, curvatures of 0.7 tolerances a unit are expected."""
    surface = partial(_BayesianSurface, noise=0.3, linear_sd=5.0, quadratic_sd=0.7)
    return ForwardModel(spec, seed, surface, noise=0.0, trust=4.0)


@final
class _RidgeSurface:
    """scikit-learn's Ridge on PolynomialFeatures(2), refitted after each fiftieth more trials."""

    def __init__(self, entries: int, size: int, alpha: float) -> None:
        self._entries, self._size, self._alpha = entries, size, alpha
        self._expand = PolynomialFeatures(2).fit(np.zeros((1, size)))
        self._x: list[Array] = []
        self._y: list[Array] = []
        self._fitted: tuple[int, Array] = (0, np.zeros((entries, 0)))

    def add(self, x: Array, y: Array) -> None:
        self._x.append(x)
        self._y.append(y)

    def fit(self) -> SurfaceFit:
        if len(self._x) >= REFIT * self._fitted[0]:
            features, y = self._expand.transform(np.array(self._x)), np.array(self._y)
            weights = np.zeros((self._entries, features.shape[1]))
            for entry in range(self._entries):
                seen = np.isfinite(y[:, entry])
                if seen.any():
                    model = Ridge(self._alpha, fit_intercept=False).fit(features[seen], y[seen, entry])
                    weights[entry] = model.coef_
            self._fitted = len(self._x), weights
        return _quadratic(self._fitted[1], self._size)


def ridge_quadratic(spec: TaskSpec, seed: int) -> ForwardModel:
    """A practitioner's first attempt with scikit-learn: polynomial ridge regression, explored by noise on goals."""
    return ForwardModel(spec, seed, partial(_RidgeSurface, alpha=1.0), noise=0.1, trust=4.0)
