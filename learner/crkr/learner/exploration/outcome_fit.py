"""The outcome near each of several trials, as a straight line through the nearest trials that were executed.

    w  (k,)    weights of the neighbours        o      outcome at x           h   distance of the farthest
    D  (k, d + p) neighbours minus x            J      its slope with the goal
    F  (k, r)  regressors [1, D / h]            A  (r, r)  F' diag(w) F + ridge, A^-1 = M' M
    Y  (k, m)  outcomes                         B  (r, m)  A^-1 F' diag(w) Y            r   1 + d + p

Every array has one x more in front, b of them; each x gets the same bits in whatever company. Everything is scaled as
`OutcomeScales` says; outcomes count in tolerances from the target. Entries that are observed in the same trials share
neighbours, weights and factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from scipy.linalg import lapack

from crkr.learner.exploration.outcome_neighbours import Neighbours
from crkr.learner.exploration.outcome_scales import GOAL_SHARE
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["RIDGE", "LocalFit", "fit_locally", "inverse_factor", "times"]

RIDGE: Final = 1e-3  # for slopes per h; the weights sum to the number of neighbours that count
_COINCIDING: Final = 1e-18  # squared distance below which trials tell no slope; it would be beyond all numbers
_PIVOT: Final = 1e-10  # of the intercept, so that the matrix always factors


@final
@dataclass(frozen=True, slots=True, eq=False)
class LocalFit:
    """The outcome near b points x, from s sets of neighbours; made by `fit_locally`.

    Attributes:
        o: (b, m) the entries at x.
        J: (b, m, p) their change with each scaled goal.
        variance: (b, m) of the residuals.
        leverage: (b, m) how much less is known at x than a residual tells, in residual variances.
        M: (s, b, r, r) inverses of the lower factors of A.
        slope: (s, b) what a scaled goal counts in h; 0 where all neighbours are at x.
        sets: (m,) which of the sets an entry was observed in.
    """

    o: Array
    J: Array
    variance: Array
    leverage: Array
    M: Array
    slope: Array
    sets: Indices

    def at(self, step: Array) -> tuple[Array, Array]:
        """Predicted entries (b, m) and their standard deviations (b, m) steps (b, p) of the scaled goal away from x."""
        s, b, r, _ = self.M.shape
        f = np.zeros((s, b, r))
        f[:, :, 0] = 1.0
        f[:, :, r - step.shape[1] :] = step * self.slope[:, :, None]
        v = times(self.M, f)
        pulls = 1.0 + np.vecdot(v, v)
        return self.o + times(self.J, step), np.sqrt(self.variance * pulls[self.sets].T)

    def of(self, which: Indices) -> LocalFit:
        """That near some of the points."""
        return LocalFit(
            self.o[which],
            self.J[which],
            self.variance[which],
            self.leverage[which],
            self.M[:, which],
            self.slope[:, which],
            self.sets,
        )

    def beside(self, other: LocalFit) -> LocalFit:
        """Both in one, this one's entries first."""
        return LocalFit(
            np.concatenate([self.o, other.o], axis=1),
            np.concatenate([self.J, other.J], axis=1),
            np.concatenate([self.variance, other.variance], axis=1),
            np.concatenate([self.leverage, other.leverage], axis=1),
            np.concatenate([self.M, other.M]),
            np.concatenate([self.slope, other.slope]),
            np.concatenate([self.sets, len(self.M) + other.sets]),
        )


def fit_locally(near: Neighbours, outcomes: Sequence[Array], goals: int, ridge: float = RIDGE) -> LocalFit:
    """Weighted ridge regression on the neighbours of each point.

    The weights are the biweight (1 - (distance / h)^2)^2 [Atkeson1997]. The farthest neighbour has weight zero, so that
    the fit is continuous in x although neighbours change. Weights are scaled to sum to the effective number of
    neighbours, (sum w)^2 / sum w^2, and only slopes are penalised.

    Args:
        near: Neighbours (s, b, k), k >= 1.
        outcomes: (b, k, m) what was observed in them, for each set m entries of its own.
        goals: p.
        ridge: Penalty of squared slopes per h.
    """
    s, b, k, r = near.D.shape
    farthest = near.squared[:, :, -1:]
    coinciding = farthest < _COINCIDING
    alike = bool(coinciding.any())
    if alike:
        farthest = np.where(coinciding, 1.0, farthest)
    reach = np.sqrt(farthest)
    slope = (GOAL_SHARE / reach)[:, :, 0]
    if alike:
        slope[coinciding[:, :, 0]] = 0.0
    w, total = _weights(near.squared / farthest)
    root = np.sqrt(w)[..., None]
    F = np.empty((s, b, k, r + 1))
    F[..., 0] = 1.0
    np.divide(near.D, reach[..., None], out=F[..., 1:])
    F *= root
    A = F.swapaxes(2, 3) @ F
    diagonal = A.reshape(s, b, -1)[:, :, :: r + 2]
    diagonal += ridge
    diagonal[:, :, 0] += _PIVOT - ridge
    M = inverse_factor(A)
    V = F @ M.swapaxes(2, 3)  # its rows' squares say how far a trial pulls the line to itself
    spare = np.maximum(total - np.vecdot(np.vecdot(V, V), w), 1e-9 * k)
    solved = [_solved(F[i], Y * root[i], M[i], slope[i], spare[i], goals) for i, Y in enumerate(outcomes)]
    o, J, variance = solved[0] if s == 1 else (np.concatenate(parts, axis=1) for parts in zip(*solved, strict=True))
    sets = np.array([i for i, Y in enumerate(outcomes) for _ in range(Y.shape[2])])
    first = M[..., 0]
    return LocalFit(o, J, variance, np.vecdot(first, first)[sets].T, M, slope, sets)


def _solved(F: Array, Y: Array, M: Array, slope: Array, spare: Array, goals: int) -> tuple[Array, Array, Array]:
    """o, J and the variance of the residuals of one set."""
    B = M.swapaxes(1, 2) @ (M @ (F.swapaxes(1, 2) @ Y))
    residuals = (Y - F @ B).swapaxes(1, 2)
    variance = np.vecdot(residuals, residuals) / spare[:, None]
    return B[:, 0], B[:, -goals:].swapaxes(1, 2) * slope[:, None, None], variance


def inverse_factor(A: Array) -> Array:
    """Inverses (..., r, r) of the lower Cholesky factors of A (..., r, r), which is used up.

    They serve for all right-hand sides, and the matrices are small and far enough from singular for that.
    """
    for one in A.reshape(-1, *A.shape[-2:]):
        L, _ = lapack.dpotrf(one.T, lower=1, clean=1, overwrite_a=1)
        lapack.dtrtri(L, lower=1, overwrite_c=1)
    return A.swapaxes(-1, -2)


def times(A: Array, x: Array) -> Array:
    """Products (..., m) of matrices (..., m, n) and vectors (..., n)."""
    return np.asarray((A @ x[..., None])[..., 0])


def _weights(shares: Array) -> tuple[Array, Array]:
    """Weights (..., k) of squared distances in shares of the farthest, or of none worth mentioning, and their sum."""
    w = 1.0 - shares
    w *= w
    squares = np.vecdot(w, w)
    if not squares.all():  # all are as far away
        w[squares == 0] = 1.0
        squares = np.vecdot(w, w)
    total = w.sum(axis=-1)
    scale = total / squares
    w *= scale[..., None]
    return w, total * scale
