"""Gaussian-process regression with a noise variance for each sample.

    Z  (m, d)   standardised states          K  (m, m)  kernel matrix of Z
    Y  (m, p)   scaled goals minus prior     N  (m,)    noise variances
    L  (m, m)   lower Cholesky factor of K + diag(N)
    W  (m, p)   weights (K + diag(N))^-1 Y
    k  (b, m)   kernel between queries and Z

Nothing is ever inverted; one factor serves all. Exchanging a sample takes a new factor: updates of a factor by numpy
and scipy are not faster up to m = 1000, where a new model takes some 12 ms. With larger budgets a step takes tens or
hundreds of milliseconds; other threads run meanwhile, see `cholesky`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from scipy.linalg import blas

from crkr.learner.cholesky import factor, solve, solve_lower
from crkr.learner.kernel import Kernel
from crkr.protocol import Array, Internal
from crkr.protocol.earlier_python import vecdot

__all__ = ["KernelMaker", "Regression"]

KernelMaker = Callable[[Kernel, Array], Array]
"""Returns the kernel matrix of standardised states (m, d), symmetric and in C order; the caller may overwrite it."""

_log = logging.getLogger(__name__)

_LIMITS: Final = np.finfo(np.float64)
_BLOCK: Final = 128  # queries per block, so that kernel rows stay in the cache
_APPEND_FROM: Final = 512  # below this size a new factor costs less than extending one
_ATTEMPTS: Final = 40  # attempts at a factor; 16 raise the floor from the rounding of K to K itself


@final
@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Posterior of the scaled goals; one kernel and one factor serve all p outputs.

    With noise lambda c this is Cost-regularized Kernel Regression [Cardoso2017, alg. 1]; with a constant it is plain
    Gaussian-process regression [Cardoso2017, eq. 3]. Make it with `fit`.

    Attributes:
        kernel: Covariance of the scaled goals.
        Z: (m, d) standardised states of the samples.
        noise: (m,) noise variances, as requested.
        L: (m, m) lower Cholesky factor, in Fortran order.
        W: (m, p) weights.
        floor: Smallest noise in force; larger than noise.min() only where that did not factor.
    """

    kernel: Kernel
    Z: Array
    noise: Array
    L: Array
    W: Array
    floor: float

    @classmethod
    def fit(
        cls,
        kernel: Kernel,
        Z: Array,
        Y: Array,
        noise: Array,
        previous: Regression | None = None,
        matrix: KernelMaker | None = None,
    ) -> Regression:
        """Factors once, O(m^3), or O(m^2 (m - n)) where `previous` holds the first n of these samples.

        Args:
            kernel: Covariance of the scaled goals.
            Z: (m, d) standardised states, m >= 1.
            Y: (m, p) scaled goals minus their prior mean.
            noise: (m,) noise variances, > 0.
            previous: An earlier regression; its factor is extended if these samples begin with its own.
            matrix: Returns the kernel matrix of Z at a lower cost; may be called more than once.

        Raises:
            Internal: The kernel matrix contains NaN, so that no noise makes it factor.
        """
        L, floor = _extended(kernel, Z, noise, previous) or _factor(kernel, Z, noise, matrix)
        if floor > float(noise.min()):
            told = previous is not None and previous.floor > float(previous.noise.min())
            _log.log(
                logging.DEBUG if told else logging.WARNING,  # once for a series of models
                "%d samples factored only with noise floor %.1e; %.1e was asked for",
                len(Z),
                floor,
                float(noise.min()),
            )
        W = solve(L, Y)
        regression = cls(kernel, Z, noise, L, np.ascontiguousarray(W), floor)
        for array in (Z, noise, L, regression.W):
            array.setflags(write=False)
        return regression

    def at(self, z: Array) -> tuple[Array, float, float]:
        """Mean (p,), variance and prior variance of the scaled goals at one standardised state (d,)."""
        k = self.kernel.matrix(z[None], self.Z)[0]
        v = blas.dtrsv(self.L, k, lower=1)
        prior = self.kernel.signal_variance
        if self.kernel.linear_weight:
            prior += self.kernel.linear_weight * float(z @ z)
        return k.dot(self.W), max(prior - float(v.dot(v)), 0.0), prior

    def over(self, Z: Array) -> tuple[Array, Array, Array]:
        """Means (b, p), variances (b,) and prior variances (b,) at standardised states (b, d)."""
        means, variances = np.empty((len(Z), self.W.shape[1])), self.kernel.variance(Z)
        prior = variances.copy()
        rows = np.empty((min(len(Z), _BLOCK), len(self.Z)))
        for start in range(0, len(Z), _BLOCK):
            block = slice(start, min(start + _BLOCK, len(Z)))
            k = self.kernel.matrix(Z[block], self.Z, out=rows[: block.stop - start])
            np.matmul(k, self.W, out=means[block])
            V = solve_lower(self.L, k.T)  # (m, b), overwrites k
            variances[block] -= vecdot(V.T, V.T)
        return means, np.maximum(variances, 0.0), prior

    def influence(self, z: Array) -> Array:
        """(m,) weights with which each sample's goal enters the mean at z, (K + diag(N))^-1 k."""
        return solve(self.L, self.kernel.matrix(z[None], self.Z).T)[:, 0]


def _factor(kernel: Kernel, Z: Array, noise: Array, matrix: KernelMaker | None) -> tuple[Array, float]:
    """Lower factor of K + diag(noise), and the noise floor it needed: ten times larger after every failed pivot.

    The floor is proportional to the diagonal of K, which varies with a linear term: one distant state must not drown
    the others. K is factored in place and recomputed for another attempt, which is rare; a copy would cost every model
    more in fresh memory than the kernel itself.
    """
    floor = float(noise.min())
    for _ in range(_ATTEMPTS):
        K = kernel.matrix(Z, Z) if matrix is None else matrix(kernel, Z)
        diagonal = K.reshape(-1)[:: len(K) + 1]
        largest = float(diagonal.max())
        floors = floor * (diagonal / largest) if kernel.linear_weight else floor
        diagonal += np.maximum(noise, floors)
        L, failed_pivot = factor(K.T)  # K is symmetric; its transpose is in the order that LAPACK wants
        if not failed_pivot:
            break
        floor = max(10.0 * floor, _LIMITS.eps * largest, _LIMITS.tiny)  # the last attempt
    else:
        raise Internal(f"the kernel matrix of {len(Z)} samples does not factor even with a noise floor of {floor:.1e}")
    return L, floor


def _extended(kernel: Kernel, Z: Array, noise: Array, previous: Regression | None) -> tuple[Array, float] | None:
    """The factor of `previous` with rows appended; None if it cannot be extended."""
    if previous is None or previous.kernel is not kernel or not _APPEND_FROM <= len(previous.Z) <= len(Z):
        return None
    n = len(previous.Z)
    if previous.floor > float(noise.min()) or not (
        np.array_equal(previous.noise, noise[:n]) and np.array_equal(previous.Z, Z[:n])
    ):
        return None
    L = np.zeros((len(Z), len(Z)), order="F")
    L[:n, :n] = previous.L
    new = Z[n:]
    rows = solve_lower(previous.L, kernel.matrix(new, Z[:n]).T)  # (n, a)
    L[n:, :n] = rows.T
    corner = kernel.matrix(new, new) + np.diag(noise[n:]) - rows.T @ rows
    L[n:, n:], failed_pivot = factor(np.asfortranarray(corner))
    return None if failed_pivot else (L, float(noise.min()))
