"""Probability of success: logistic regression on predictions and results of the newest trials.

    F  (n, f)  features, the first of them 1      y  (n,)  1 for a success, else 0      w  (f,)  weights

The weights maximise the posterior under a normal prior [Rasmussen2006, ch. 3.4 in weight space], by Newton's method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final, final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas
from scipy.special import expit

from crkr.learner.kernel import Kernel
from crkr.protocol import Array
from crkr.protocol.earlier_python import vecdot

__all__ = ["SuccessCurve", "SuccessRate"]

_STEPS: Final = 25
_STILL: Final = 1e-9
_MORE_TRIALS: Final = 2.0
_FAR: Final = 500.0  # half a squared length, up to which its exponential is a normal number
_LARGEST: Final = 30.0  # largest feature


@final
@dataclass(frozen=True, slots=True, eq=False)
class SuccessCurve:
    """P(success) = expit(w . features); made by `fit`.

    Attributes:
        weights: (f,).
    """

    weights: Array

    @classmethod
    def fit(cls, features: Array, success: NDArray[np.bool_], prior: Array, spread: float) -> SuccessCurve:
        """The curve of some trials.

        Args:
            features: (n, f); n may be 0.
            success: (n,).
            prior: (f,) prior mean of the weights.
            spread: Prior standard deviation of the weights.
        """
        F, y, w = bounded(features), success.astype(np.float64), prior.copy()
        precision = np.eye(len(prior)) / spread**2
        for _ in range(_STEPS):
            chance = expit(F @ w)
            gradient = F.T @ (y - chance) - precision @ (w - prior)
            step = np.linalg.solve((F * (chance * (1.0 - chance))[:, None]).T @ F + precision, gradient)
            w = w + step / max(1.0, float(np.abs(step).max()))  # limits steps where the curve saturates
            if np.abs(step).max() < _STILL:
                break
        w.setflags(write=False)
        return cls(w)

    def at(self, features: Array) -> Array:
        """P(success) (...,) of features (..., f)."""
        return np.asarray(expit((bounded(features) * self.weights).sum(axis=-1)))


@final
@dataclass(frozen=True, eq=False)
class SuccessRate:
    """Success rate of the newest trials in nearby states; for tasks without an outcome model.

    Everything is computed at the first use, as there are often several steps between two questions.

    Attributes:
        newest: Returns states (n, d) of the newest trials, n >= 1, and (n,) 1 for a success, else 0.
        kernel: Standardises the states; None if they are standardised already.
    """

    newest: Callable[[], tuple[Array, Array]]
    kernel: Kernel | None = None

    def at(self, z: Array) -> Array:
        """P(success) () or (b,) of a trial at standardised states (d,) or (b, d).

        A mean weighted by the squared-exponential kernel, shrunk towards the overall mean by the weight of two trials.
        """
        states, half_squares, sums, more = self._terms
        if z.ndim == 1:  # in a third of the time, with less of numpy
            half = 0.5 * float(z.dot(z))
            exponents = blas.dgemv(1.0, states, z, -1.0, half_squares)  # at most half
            if half > _FAR:
                exponents, half = np.minimum(exponents - half, 0.0), 0.0
            share = math.exp(-half)
            hits, count = np.exp(exponents, out=exponents).dot(sums).tolist()
            return np.array(min((share * hits + more) / (share * count + _MORE_TRIALS), 1.0))  # exceeded by rounding
        exponents = z @ states.T
        exponents -= half_squares
        exponents -= 0.5 * vecdot(z, z)[:, None]
        near = np.exp(np.minimum(exponents, 0.0, out=exponents), out=exponents)  # above 0 by rounding alone
        weighed = near @ sums
        return np.asarray(np.minimum((weighed[:, 0] + more) / (weighed[:, 1] + _MORE_TRIALS), 1.0))

    @cached_property
    def standardised(self) -> Array:
        """(n, d) standardised states."""
        states = self._trials[0]
        return states if self.kernel is None else self.kernel.standardise(states)

    @property
    def success(self) -> Array:
        """(n,) 1 for a success, else 0."""
        return self._trials[1]

    @cached_property
    def _trials(self) -> tuple[Array, Array]:
        return self.newest()

    @cached_property
    def _terms(self) -> tuple[Array, Array, Array, float]:
        """States (n, d) by columns, half their squares (n,), what is summed up (n, 2), the successes added."""
        states = np.asfortranarray(self.standardised)
        sums = np.stack((self.success, np.ones(len(self.success))), axis=1)
        return states, 0.5 * vecdot(states, states), sums, _MORE_TRIALS * float(self.success.mean())


def bounded(features: Array) -> Array:
    """Features, clipped to the range of the regression."""
    within = np.minimum(np.maximum(features, -_LARGEST), _LARGEST)
    return np.where(np.isnan(within), 0.0, within)
