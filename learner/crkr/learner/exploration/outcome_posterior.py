"""The goal that should hit, and how free it still is: a prior conditioned on the outcome by a Kalman update.

    m  (p,)  mean goal            s2  (p,)  variance it may be moved by      g  (p,)    goal that is expected to hit
    o  (m,)  outcome at `where`   J  (m, p) its slope                        R  (m,)    variance of what o leaves out
                                  S  (m, m) J diag(s2) J' + R                G  (p, m)  gain diag(s2) J' S^-1

Every array has b rows in front, one for each state. Goals are in scales from the middle of their bounds, outcomes in
tolerances from the target.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Final, final

import numpy as np

from crkr.learner.exploration.outcome_fit import LocalFit, fit_locally, inverse_factor, times
from crkr.learner.exploration.outcome_index import ObservedTrials
from crkr.learner.exploration.outcome_neighbours import nearest
from crkr.learner.exploration.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["OutcomeLine", "Posterior", "condition", "linearise"]

_ROUNDING: Final = 1e-12  # of the largest variance, so that entries which say the same still factor


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeLine:
    """The outcome as a straight line in the goal, at b states.

    Attributes:
        where: (b, p) goals that it touches.
        fit: The line.
        entries: (m,) which outcome entries the fit is of.
    """

    where: Array
    fit: LocalFit
    entries: Indices

    @property
    def worst(self) -> Array:
        """(b,) largest deviations from the target where the line touches."""
        return np.asarray(np.abs(self.fit.o).max(axis=1))

    def at(self, goal: Array) -> tuple[Array, Array]:
        """Outcomes (b, m) at goals (b, p), and their standard deviations (b, m)."""
        return self.fit.at(goal - self.where)

    def of(self, which: Indices) -> OutcomeLine:
        """That at some of the states."""
        return OutcomeLine(self.where[which], self.fit.of(which), self.entries)


@final
@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """N(g, P') at b states, with P' = (I - G J) diag(s2).

    Attributes:
        g: (b, p) its mean.
        spread: (b, p) square roots of s2.
        J: (b, m, p).
        G: (b, p, m).
        noise: (b, m) square roots of R.
    """

    g: Array
    spread: Array
    J: Array
    G: Array
    noise: Array

    def deviations(self, normal: Array) -> Array:
        """Deviations (b, a, p) from g with covariance P', of standard normal numbers (b, a, p + m).

        A draw of the prior is conditioned on a drawn error of the outcome, which needs no factor of P' and is right
        where P' has none.
        """
        p = self.g.shape[1]
        prior = normal[..., :p] * self.spread[:, None]
        error = normal[..., p:] * self.noise[:, None]
        return np.asarray(prior - (prior @ self.J.swapaxes(1, 2) + error) @ self.G.swapaxes(1, 2))

    def of(self, which: Indices) -> Posterior:
        """That at some of the states."""
        return Posterior(*(part[which] for part in (self.g, self.spread, self.J, self.G, self.noise)))


def linearise(
    trials: ObservedTrials, scales: OutcomeScales, groups: Sequence[int], x: Array, count: int
) -> OutcomeLine:
    """Fits every group to its `count` trials nearest to each x.

    Args:
        trials: What is searched.
        scales: The task's units.
        groups: Which groups are modelled, at least one.
        x: (b, d + p) trials in the metric.
        count: Neighbours.
    """
    p = len(scales.scales)
    fits, together = [], []
    for counted, sets in _sets(trials, groups, count):
        near = nearest(trials, x, [one[0] for one in sets], counted)
        entries = [np.concatenate([scales.groups[group] for group in one]) for one in sets]
        outcomes = [trials.Y[rows[:, :, None], own] for rows, own in zip(near.rows, entries, strict=True)]
        fits.append(fit_locally(near, outcomes, p))
        together += entries
    return OutcomeLine(x[:, -p:] / GOAL_SHARE, reduce(LocalFit.beside, fits), np.concatenate(together))


def _sets(trials: ObservedTrials, groups: Sequence[int], count: int) -> Iterable[tuple[int, list[list[int]]]]:
    """Numbers of neighbours, and for each the groups that have so many; those observed in the same trials together."""
    everywhere = [group for group in groups if trials.hidden[group] is None]
    together = [everywhere] if everywhere else []
    sets: dict[int, list[list[int]]] = {}
    for one in together + [[group] for group in groups if group not in everywhere]:
        sets.setdefault(min(count, trials.counts[one[0]]), []).append(one)
    return sets.items()


def condition(mean: Array, spread: Array, line: OutcomeLine) -> Posterior:
    """The priors N(mean, diag(spread^2)), given that the outcome is the target  [Rasmussen2006, A.6].

    R is one squared tolerance and the variance of the residuals, more where neighbours say little.

    Args:
        mean: (b, p) mean goals.
        spread: (b, p) their standard deviations.
        line: The outcome at b states.
    """
    fit, J = line.fit, line.fit.J
    R = fit.variance * (1.0 + fit.leverage) + 1.0
    JP = J * (spread * spread)[:, None]
    S = JP @ J.swapaxes(1, 2)
    diagonal = S.reshape(len(S), -1)[:, :: S.shape[1] + 1]
    diagonal += R + _ROUNDING * diagonal.max(axis=1, keepdims=True)
    M = inverse_factor(S)
    G = (M.swapaxes(1, 2) @ (M @ JP)).swapaxes(1, 2)
    g = mean - times(G, fit.o + times(J, mean - line.where))
    return Posterior(g, spread, J, G, np.sqrt(R))
