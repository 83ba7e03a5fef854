"""Gaussian-process regression near each of several points, on the trials nearest to it  [Rasmussen2006, alg. 2.1].

    x  (r,)    a point: a trial in the metric of `OutcomeScales`     a  (p,)    a step from x in the goal's coordinates
    D  (k, r)  its k neighbours minus x                               Y  (k, m)  what was observed in them
    K  (k, k)  kernel of the rows of D plus noise                     L  (k, k)  its lower factor, K = L L'
    alpha  (k, m)  K^-1 Y

Every array has a leading axis of b points. A point's result does not depend on the other points of the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, final

import numpy as np
from scipy.linalg import blas, lapack

from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["LocalGP", "StepKernel", "inverse_factor"]

_FARTHEST: Final = 1e3  # length of a row of D; longer ones are shortened, so that K always factors
_CHUNK: Final = 4  # points whose matrices fit into the processor's cache
_PRIOR_TRIALS: Final = 10.0  # weight of the prior "the amplitude is 1", in trials


@final
@dataclass(frozen=True, slots=True)
class StepKernel:
    """k(a, b) = constant + linear a.b + bend exp(-|a - b|^2 / (2 reach^2)), for steps from the point.

    Linear far from the data, curved near by.

    Attributes:
        constant: Prior variance at the point.
        linear: Of each slope.
        bend: Prior variance of the curved part.
        reach: Length-scale of the curved part, in the metric.
        noise: Variance of one observation.
        change: Prior variance of the difference that a change of the robot makes, as a share of the prior variance.
    """

    constant: float
    linear: float
    bend: float
    reach: float
    noise: float
    change: float = 0.5

    @property
    def log_bend(self) -> float:
        """Logarithm of `bend`; a large negative number for 0."""
        return math.log(max(self.bend, 1e-300))


@final
@dataclass(frozen=True, slots=True, eq=False)
class LocalGP:
    """Regression near b points; made by `fit`.

    Attributes:
        kernel: Its prior.
        D: (b, k, p) goal part of the neighbours minus the point.
        Z: (b, k, d) the same of the state.
        squares: (b, k) their whole squared length.
        alpha: (b, k, m).
        factors: b matrices (k, k), L below the diagonal, undefined above.
        amplitude: (b, m) factor on the prior's variances for each entry.
        former: Number of neighbours, at the end, from before the robot changed.
    """

    kernel: StepKernel
    D: Array
    Z: Array
    squares: Array
    alpha: Array
    factors: tuple[Array, ...]
    amplitude: Array
    former: int = 0

    @classmethod
    def fit(
        cls, kernel: StepKernel, D: Array, Y: Array, p: int, noise: Array | None = None, former: int = 0
    ) -> LocalGP:
        """Regression on the neighbours of each point.

        The prior is scaled for each entry by the evidence-maximising amplitude, shrunk towards 1 by the weight of ten
        trials. A changed robot is modelled as the old one plus a process of the same kernel, so that trials from before
        and after teach it [Bonilla2007].

        Args:
            kernel: The prior.
            D: (b, k, r) neighbours minus their point, k >= 1.
            Y: (b, k, m) what was observed.
            p: Number of the r coordinates, at the end, that are the goal's.
            noise: (b, k) variance of each observation; None: the kernel's.
            former: Number of neighbours, at the end, from before the robot changed.
        """
        squares = np.vecdot(D, D)
        if squares.max() > _FARTHEST**2:
            D = D * np.minimum(1.0, _FARTHEST / np.sqrt(np.maximum(squares, _FARTHEST**2)))[..., None]
            squares = np.vecdot(D, D)
        k = D.shape[1]
        noise = np.full(squares.shape, kernel.noise) if noise is None else noise
        alpha, fitted = np.empty((2, *Y.shape))
        factors: list[Array] = []
        for first in range(0, len(D), _CHUNK):
            part = slice(first, first + _CHUNK)
            K = _kernel(kernel, D[part] @ D[part].swapaxes(1, 2), squares[part], squares[part])
            if former:
                K[:, : k - former, : k - former] *= 1.0 + kernel.change
            diagonal = K.reshape(len(K), -1)[:, :: k + 1]
            diagonal += noise[part]
            for row, one in enumerate(K, first):
                L, _ = lapack.dpotrf(one.T, lower=1, clean=0, overwrite_a=1)  # overwrites K
                factors.append(L)
                W = blas.dtrsm(1.0, L, Y[row], lower=1)
                fitted[row] = W
                alpha[row] = blas.dtrsm(1.0, L, W, lower=1, trans_a=1, overwrite_b=1)
        amplitude = ((fitted * fitted).sum(axis=1) + _PRIOR_TRIALS) / (k + _PRIOR_TRIALS)
        return cls(kernel, D[..., -p:], D[..., :-p], squares, alpha, tuple(factors), amplitude, former)

    def mean(self, steps: Array) -> Array:
        """(b, c, m) expectations at steps (b, c, p)."""
        return np.asarray(self._cross(steps)[0] @ self.alpha)

    def at(self, steps: Array) -> tuple[Array, Array]:
        """Expectations (b, c, m) at steps (b, c, p) and variances (b, c, m) of an observation there."""
        cross, lengths = self._cross(steps)
        mean = cross @ self.alpha
        for L, one in zip(self.factors, cross, strict=True):  # L^-1 cross', overwriting it
            blas.dtrsm(1.0, L, one.T, lower=1, overwrite_b=1)
        return mean, self._variance(lengths, np.vecdot(cross, cross))

    def _variance(self, lengths: Array, known: Array) -> Array:
        """Variances (b, ..., m) of an observation, of squared lengths of steps (b, ...) and |L^-1 cross|^2."""
        own = self.kernel
        prior = own.constant + own.bend + own.linear * lengths
        if self.former:
            prior *= 1.0 + own.change
        rest = np.maximum(prior - known, 0.0) + own.noise
        shape = len(rest), *[1] * (rest.ndim - 1), -1
        return np.asarray(rest[..., None] * self.amplitude.reshape(shape))

    def line(self, step: Array) -> tuple[Array, Array, Array]:
        """Expectations (b, m) at steps (b, p), variances (b, m) of an observation there, and slopes (b, m, p).

        A slope is the derivative of the expectation by the goal's coordinates in the metric.
        """
        cross, pull, lengths = self._line(step)
        mean = (cross[:, None] @ self.alpha)[:, 0]
        for L, one in zip(self.factors, cross, strict=True):
            blas.dtrsv(L, one, lower=1, overwrite_x=1)
        return mean, self._variance(lengths, np.vecdot(cross, cross)), self._slope(step, pull)

    def tangent(self, step: Array) -> tuple[Array, Callable[[], Array]]:
        """Expectations (b, m) at steps (b, p), and what computes their slopes (b, m, p), at most once."""
        cross, pull, _ = self._line(step)
        return (cross[:, None] @ self.alpha)[:, 0], partial(self._slope, step, pull)

    def _line(self, step: Array) -> tuple[Array, Array, Array]:
        """Kernel (b, k) between steps and neighbours, its curved part, and the steps' squared lengths (b,)."""
        own, lengths = self.kernel, np.vecdot(step, step)
        dots = (self.D @ step[..., None])[..., 0]
        bend = dots - 0.5 * (self.squares + lengths[:, None])
        bend /= own.reach**2
        np.exp(bend, out=bend)
        bend *= own.bend
        dots *= own.linear
        dots += own.constant
        dots += bend
        return self._with_change(dots), self._with_change(bend), lengths

    def _slope(self, step: Array, pull: Array) -> Array:
        """(b, m, p) slopes of the expectations at steps (b, p), from the curved part of the kernel, overwritten."""
        own = self.kernel
        pull /= own.reach**2
        linear = pull + (self._with_change(np.full(pull.shape[1], own.linear)) if self.former else own.linear)
        slope = (self.alpha * linear[..., None]).swapaxes(1, 2) @ self.D
        slope -= (pull[:, None] @ self.alpha).swapaxes(1, 2) * step[:, None]
        return slope

    def state_slope(self) -> Array:
        """(b, m, d) derivatives of the expectation at the point by the state's coordinates in the metric."""
        own = self.kernel
        pull = self._with_change(np.exp(own.log_bend - 0.5 / own.reach**2 * self.squares) / own.reach**2)
        pull += self._with_change(np.full(pull.shape[1], own.linear))
        return np.asarray((self.alpha * pull[..., None]).swapaxes(1, 2) @ self.Z)

    def of(self, which: Indices) -> LocalGP:
        """The regression near some of the points."""
        factors = tuple(self.factors[point] for point in which.tolist())
        parts = (self.D[which], self.Z[which], self.squares[which], self.alpha[which], factors, self.amplitude[which])
        return LocalGP(self.kernel, *parts, self.former)

    def _cross(self, steps: Array) -> tuple[Array, Array]:
        """Kernel (b, c, k) between steps and neighbours, and the steps' squared lengths (b, c)."""
        lengths = np.vecdot(steps, steps)
        cross = _kernel(self.kernel, steps @ self.D.swapaxes(1, 2), lengths, self.squares)
        return self._with_change(cross), lengths

    def _with_change(self, cross: Array) -> Array:
        """Covariances (b, ..., k) with the neighbours, larger for those since the last change; in place."""
        if self.former:
            cross[..., : cross.shape[-1] - self.former] *= 1.0 + self.kernel.change
        return cross


def _kernel(kernel: StepKernel, dots: Array, left: Array, right: Array) -> Array:
    """The kernel (b, a, k) of rows, from their squared lengths and their products (b, a, k), which are overwritten."""
    half = 0.5 / kernel.reach**2
    bend = dots * (2.0 * half)
    bend -= (half * left - kernel.log_bend)[..., None]
    bend -= (half * right)[:, None]
    np.exp(bend, out=bend)
    dots *= kernel.linear
    dots += kernel.constant
    dots += bend
    return dots


def inverse_factor(A: Array) -> Array:
    """Inverses (..., r, r) of the lower Cholesky factors of A (..., r, r), which is overwritten.

    They serve all right-hand sides; the matrices are small and well conditioned.
    """
    for one in A.reshape(-1, *A.shape[-2:]):
        L, _ = lapack.dpotrf(one.T, lower=1, clean=1, overwrite_a=1)
        lapack.dtrtri(L, lower=1, overwrite_c=1)
    return A.swapaxes(-1, -2)
