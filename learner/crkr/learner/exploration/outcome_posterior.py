"""The posterior over goals that hit the target: a prior conditioned on the outcome by a Kalman update.

    m  (p,)  mean goal            s2  (p,)  prior variance      g  (p,)    goal expected to hit
    o  (m,)  outcome at `where`   J  (m, p) its slope                        R  (m,)    variance around o
                                  S  (m, m) J diag(s2) J' + R                G  (p, m)  gain diag(s2) J' S^-1

Every array has a leading axis of b states. Goals are in scales from the middle of their bounds, outcomes in tolerances
from the target. A zero row of o and J carries no information.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.learner.exploration.local_gp import inverse_factor
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["OutcomeLine", "Posterior", "condition", "condition_within"]

_ROUNDING: Final = 1e-12  # of the largest variance, so that redundant entries still factor


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeLine:
    """The outcome linearised in the goal, at b states.

    Attributes:
        where: (b, p) goals where it is exact.
        o: (b, m) the outcome there.
        J: (b, m, p) its slope.
        R: (b, m) variance around the line.
    """

    where: Array
    o: Array
    J: Array
    R: Array

    def of(self, which: Indices) -> OutcomeLine:
        """That at some of the states."""
        return OutcomeLine(self.where[which], self.o[which], self.J[which], self.R[which])


@final
@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """N(g, P') at b states, with P' = (I - G J) diag(s2).

    Attributes:
        g: (b, p) its mean.
        spread: (b, p) square roots of s2.
        J: (b, m, p).
        G: (b, p, m).
        R: (b, m).
    """

    g: Array
    spread: Array
    J: Array
    G: Array
    R: Array

    def deviations(self, normal: Array) -> Array:
        """Deviations (b, a, p) from g with covariance P', of standard normal numbers (b, a, p + m).

        Conditions a draw of the prior on a drawn error of the outcome. This needs no factor of P', which may be
        singular.
        """
        p = self.g.shape[1]
        prior = normal[..., :p] * self.spread[:, None]
        error = normal[..., p:] * np.sqrt(self.R)[:, None]
        return np.asarray(prior - (prior @ self.J.swapaxes(1, 2) + error) @ self.G.swapaxes(1, 2))

    def of(self, which: Indices) -> Posterior:
        """That at some of the states."""
        if len(which) == len(self.g):
            return self
        return Posterior(*(part[which] for part in (self.g, self.spread, self.J, self.G, self.R)))

    def put(self, which: Indices, other: Posterior) -> None:
        """Replaces the rows of some states by those of `other`."""
        for own, new in ((self.g, other.g), (self.J, other.J), (self.G, other.G), (self.R, other.R)):
            own[which] = new


def condition(mean: Array, spread: Array, line: OutcomeLine) -> Posterior:
    """The priors N(mean, diag(spread^2)), given that the outcome is the target  [Rasmussen2006, A.6].

    Args:
        mean: (b, p) mean goals.
        spread: (b, p) their standard deviations.
        line: The outcome at b states.
    """
    J = line.J
    JP = J * (spread * spread)[:, None]
    S = JP @ J.swapaxes(1, 2)
    diagonal = S.reshape(len(S), -1)[:, :: S.shape[1] + 1]
    diagonal += line.R + _ROUNDING * diagonal.max(axis=1, keepdims=True)
    M = inverse_factor(S)
    G = (M.swapaxes(1, 2) @ (M @ JP)).swapaxes(1, 2)
    expected = line.o + (J @ (mean - line.where)[..., None])[..., 0]
    return Posterior(mean - (G @ expected[..., None])[..., 0], spread, J, G, line.R)


def condition_within(mean: Array, spread: Array, line: OutcomeLine, scales: OutcomeScales) -> Posterior:
    """The same with a mean within the bounds: coordinates outside are fixed at their bound, and the others adapt."""
    found = condition(mean, spread, line)
    g = scales.within(found.g)
    beyond = g != found.g
    if beyond.any():
        rows = np.flatnonzero(beyond.any(axis=1))
        held, fixed = beyond[rows], g[rows]
        mean, spread = np.where(held, fixed, mean[rows]), np.where(held, 0.0, spread[rows])
        g[rows] = scales.within(condition(mean, spread, line.of(rows)).g)
    return Posterior(g, found.spread, found.J, found.G, found.R)
