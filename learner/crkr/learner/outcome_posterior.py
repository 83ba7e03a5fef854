"""The goal that should hit, and how free it still is: a prior conditioned on the outcome by a Kalman update.

    m  (p,)  mean goal            s2  (p,)  variance it may be moved by      g  (p,)    goal that is expected to hit
    o  (m,)  outcome at `where`   J  (m, p) its slope                        R  (m,)    variance of what o leaves out
                                  S  (m, m) J diag(s2) J' + R                G  (p, m)  gain diag(s2) J' S^-1

Goals are in scales from the middle of their bounds, outcomes in tolerances from the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from scipy.linalg import lapack

from crkr.learner.outcome_fit import LocalFit, fit_locally, nearest
from crkr.learner.outcome_index import ObservedTrials
from crkr.learner.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.protocol import Array

__all__ = ["OutcomeLine", "Posterior", "condition", "linearise"]

_ROUNDING: Final = 1e-12  # of the largest variance, so that entries which say the same still factor


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeLine:
    """The outcome as a straight line in the goal, at one state.

    Attributes:
        where: (p,) goal that it touches.
        fits: One for each group that is modelled.
        entries: (m,) outcome entries in the order of the fits.
    """

    where: Array
    fits: tuple[LocalFit, ...]
    entries: Array

    @property
    def worst(self) -> float:
        """Largest deviation from the target where the line touches."""
        return max(float(np.abs(fit.o).max()) for fit in self.fits)

    def at(self, goal: Array) -> tuple[Array, Array]:
        """Outcome (m,) at a goal (p,), and its standard deviation (m,)."""
        predictions = [fit.at(goal - self.where) for fit in self.fits]
        return np.concatenate([o for o, _ in predictions]), np.concatenate([sd for _, sd in predictions])


@final
@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """N(g, P'), with P' = (I - G J) diag(s2).

    Attributes:
        g: (p,) its mean.
        spread: (p,) square roots of s2.
        J: (m, p).
        G: (p, m).
        noise: (m,) square roots of R.
    """

    g: Array
    spread: Array
    J: Array
    G: Array
    noise: Array

    def deviations(self, normal: Array) -> Array:
        """Deviations (a, p) from g with covariance P', of standard normal numbers (a, p + m).

        A draw of the prior is conditioned on a drawn error of the outcome, which needs no factor of P' and is right
        where P' has none.
        """
        prior = normal[:, : len(self.g)] * self.spread
        error = normal[:, len(self.g) :] * self.noise
        return np.asarray(prior - (prior @ self.J.T + error) @ self.G.T)


def linearise(
    trials: ObservedTrials, scales: OutcomeScales, groups: Sequence[int], x: Array, count: int
) -> OutcomeLine:
    """Fits every group to its `count` trials nearest to x.

    Args:
        trials: What is searched.
        scales: The task's units.
        groups: Which groups are modelled, at least one.
        x: (d + p,) a trial in the metric.
        count: Neighbours.
    """
    p = len(scales.scales)
    distances = trials.norms - 2.0 * (trials.X @ x)  # less |x|^2, the same for all
    fits = []
    for group in groups:
        rows = nearest(trials, distances, group, count)
        fits.append(fit_locally(trials, rows, scales.groups[group], x, p))
    entries = np.concatenate([scales.groups[group] for group in groups])
    return OutcomeLine(x[-p:] / GOAL_SHARE, tuple(fits), entries)


def condition(mean: Array, spread: Array, line: OutcomeLine) -> Posterior:
    """The prior N(mean, diag(spread^2)), given that the outcome is the target  [Rasmussen2006, A.6].

    R is one squared tolerance and the variance of the residuals, more where neighbours say little.
    """
    fits = line.fits
    J = np.concatenate([fit.J for fit in fits])
    o = np.concatenate([fit.o for fit in fits])
    R = np.concatenate([fit.variance * (1.0 + fit.leverage) for fit in fits])
    R += 1.0
    JP = J * (spread * spread)
    S = JP @ J.T
    diagonal = S.reshape(-1)[:: len(S) + 1]
    diagonal += R + _ROUNDING * diagonal.max()
    L, _ = lapack.dpotrf(S.T, lower=1, clean=1, overwrite_a=1)
    gain, _ = lapack.dpotrs(L, JP, lower=1)
    G = gain.T
    return Posterior(mean - G @ (o + J @ (mean - line.where)), spread, J, G, np.sqrt(R))
