"""The outcome near one trial, as a straight line through the nearest trials that were executed.

    x  (d + p,)  where                 w  (k,)    weights of the neighbours       o      outcome at x
    D  (k, d + p) neighbours minus x   h          distance of the farthest        J      its slope with the goal
    F  (k, r)    regressors [1, D / h] A  (r, r)  F' diag(w) F + ridge            r      1 + d + p
    Y  (k, m)    outcomes              B  (r, m)  A^-1 F' diag(w) Y

Everything is scaled as `OutcomeScales` says; outcomes count in tolerances from the target. Entries of one group are
observed in the same trials and share neighbours, weights and factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from scipy.linalg import blas, lapack

from crkr.learner.anms_batch import Indices
from crkr.learner.outcome_index import ObservedTrials
from crkr.learner.outcome_scales import GOAL_SHARE
from crkr.protocol import Array

__all__ = ["RIDGE", "LocalFit", "fit_locally", "nearest"]

RIDGE: Final = 1e-3  # for slopes per h; the weights sum to the number of neighbours that count
_COINCIDING: Final = 1e-18  # squared distance below which trials tell no slope; it would be beyond all numbers
_PIVOT: Final = 1e-10  # of the intercept, so that the matrix always factors


@final
@dataclass(frozen=True, slots=True, eq=False)
class LocalFit:
    """One group's outcome near x; made by `fit_locally`.

    Attributes:
        o: (m,) the group's entries at x.
        J: (m, p) their change with each scaled goal.
        variance: (m,) of the residuals.
        leverage: How much less is known at x than a residual tells, in residual variances.
        L: (r, r) lower factor of A.
        reach: h.
    """

    o: Array
    J: Array
    variance: Array
    leverage: float
    L: Array
    reach: float

    def at(self, step: Array) -> tuple[Array, Array]:
        """Predicted entries (m,) and their standard deviations (m,) a step (p,) of the scaled goal away from x."""
        f = np.zeros(len(self.L))
        f[0] = 1.0
        if self.reach:
            f[len(f) - len(step) :] = step * (GOAL_SHARE / self.reach)
        v = blas.dtrsv(self.L, f, lower=1)
        return self.o + self.J @ step, np.sqrt(self.variance * (1.0 + v @ v))


def nearest(trials: ObservedTrials, distances: Array, group: int, count: int) -> Indices:
    """Rows of the `count` smallest of the (n,) distances among those in which a group was observed."""
    members = trials.members[group]
    if members is not None:
        distances = distances[members]
    if len(distances) <= count:
        return np.arange(len(distances)) if members is None else members
    rows = np.argpartition(distances, count - 1)[:count]
    return rows if members is None else np.asarray(members[rows])


def fit_locally(
    trials: ObservedTrials, rows: Indices, entries: Indices, x: Array, goals: int, ridge: float = RIDGE
) -> LocalFit:
    """Weighted ridge regression on these rows.

    The weights are the biweight (1 - (distance / h)^2)^2 [Atkeson1997]. The farthest neighbour has weight zero, so that
    the fit is continuous in x although neighbours change. Weights are scaled to sum to the effective number of
    neighbours, (sum w)^2 / sum w^2, and only slopes are penalised.

    Args:
        trials: What is searched.
        rows: (k,) which of them, k >= 1.
        entries: (m,) entries of the group.
        x: (d + p,) where.
        goals: p.
        ridge: Penalty of squared slopes per h.
    """
    F = np.empty((len(rows), len(x) + 1))
    F[:, 0] = 1.0
    D = np.subtract(trials.X[rows], x, out=F[:, 1:])
    d2 = np.vecdot(D, D)
    farthest = float(d2.max())
    if farthest < _COINCIDING:
        farthest = 0.0
    reach = farthest**0.5
    if reach:
        D /= reach
    w = _weights(d2, farthest)
    Y = trials.Y[rows][:, entries]
    root = np.sqrt(w)[:, None]
    F *= root
    Y *= root
    A = F.T @ F
    diagonal = A.reshape(-1)[:: len(A) + 1]
    diagonal += ridge
    diagonal[0] += _PIVOT - ridge
    L, _ = lapack.dpotrf(A.T, lower=1, clean=1, overwrite_a=1)
    B, _ = lapack.dpotrs(L, F.T @ Y, lower=1)
    residuals = Y - F @ B
    V = blas.dtrsm(1.0, L, F.T, lower=1)  # (r, k); its columns' squares say how far a trial pulls the line to itself
    spare = float(w.sum() - np.vecdot(V.T, V.T) @ w)
    variance = np.vecdot(residuals.T, residuals.T) / max(spare, 1e-9 * len(rows))
    first = np.zeros(len(L))
    first[0] = 1.0
    v = blas.dtrsv(L, first, lower=1)
    J = B[-goals:].T * (GOAL_SHARE / reach) if reach else np.zeros((len(entries), goals))
    return LocalFit(B[0], J, variance, float(v @ v), L, reach)


def _weights(d2: Array, farthest: float) -> Array:
    if farthest:
        w = (1.0 - d2 / farthest) ** 2
        total = float(w.sum())
        if total:
            w *= total / float(w @ w)
            return w
    return np.ones(len(d2))
