"""Exploration guided by measured outcomes: goals that are as likely as the regression says, and should also hit.

A prior from the regression of successes is conditioned on the outcome being the target, as seen by a local linear model
of all executed trials: a Kalman update, linearised again where it leads to. Misses thus teach as much as hits, and
noise is left in those directions of the goal that do not change the outcome. Learned forward models guide contextual
policy search in [Kupcsik2013]; here the regression's own uncertainty bounds how far they are trusted.

Draws of a correlated normal within bounds are by rejection: the first of `_ATTEMPTS` that lies within, which is exact;
should none do, the first one with each coordinate moved to the nearer bound. After the p uniforms of a trial (see
draws.py) the next one chooses its temperature, the next q are for the first attempt, and p + q for each further one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, final
from uuid import UUID

import numpy as np
from scipy.special import ndtri

from crkr.learner.draws import uniforms
from crkr.learner.explorer import Choice, GaussianExplorer
from crkr.learner.outcome_index import ObservedTrials
from crkr.learner.outcome_posterior import OutcomeLine, Posterior, condition, linearise
from crkr.learner.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.protocol import Array, Exploration, TaskSpec

__all__ = ["OutcomeExplorer"]

_ATTEMPTS: Final = 32


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeExplorer:
    """Goals conditioned on the target outcome; plain ones until enough outcomes were observed. Make it with `of`.

    Attributes:
        plain: Answers until then, and gives the goals that are corrected.
        settings: The task's `exploration`.
        scales: The task's units.
        trials: What was observed so far.
        groups: Those groups of outcomes that were observed in `min_trials` trials or more; others are not modelled.
    """

    plain: GaussianExplorer
    settings: Exploration
    scales: OutcomeScales
    trials: ObservedTrials
    groups: tuple[int, ...]

    @classmethod
    def of(cls, spec: TaskSpec, scales: OutcomeScales, trials: ObservedTrials) -> OutcomeExplorer:
        """That of a task; `with_trials` gives later ones."""
        return cls(GaussianExplorer.of(spec), spec.exploration, scales, trials, ()).with_trials(trials)

    def with_trials(self, trials: ObservedTrials) -> OutcomeExplorer:
        """The same with other trials to look up."""
        groups = range(len(self.scales.groups))
        enough = tuple(group for group in groups if trials.count(group) >= self.settings.min_trials)
        return replace(self, trials=trials, groups=enough)

    @property
    def searched(self) -> int:
        """The observed trials, once they are enough."""
        return len(self.trials) if self.groups else 0

    def best(self, states: Array, means: Array, sigmas: Array) -> Choice:
        """The plain goals where they should do, otherwise the conditioned ones.

        A goal is corrected where some entry of its own predicted outcome is more than `gate` tolerances off.
        """
        plain = self.plain.best(states, means, sigmas)
        if not self.groups:
            return plain
        if means.ndim == 1:
            return self._best(states, plain.goals, sigmas)
        return _stacked([self._best(*row) for row in zip(states, plain.goals, sigmas, strict=True)])

    def draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        """Draws from N(g, temperature^2 P'), the conditioned prior; the trial id decides the temperature too."""
        if not self.groups:
            return self.plain.draw(states, means, sigmas, ids)
        if means.ndim == 1:
            return self._draw(states, means, sigmas, ids[0])
        return _stacked([self._draw(*row) for row in zip(states, means, sigmas, ids, strict=True)])

    def _best(self, state: Array, plain: Array, sigma: Array) -> Choice:
        z, mean = self.scales.metric.standardise(state), self.scales.scaled(plain)
        line = self._line(z, mean)
        if line.worst <= self.settings.gate:
            return self._choice(plain, mean, line, corrected=False)
        posterior, line = self._conditioned(z, mean, sigma, line)
        return self._choice(self._goal(posterior.g), posterior.g, line, corrected=True)

    def _draw(self, state: Array, mean: Array, sigma: Array, trial_id: UUID) -> Choice:
        z, centre = self.scales.metric.standardise(state), self.scales.scaled(mean)
        posterior, line = self._conditioned(z, centre, sigma, self._line(z, centre))
        drawn = self._drawn(posterior, line, trial_id)
        return self._choice(self._goal(drawn), drawn, line, corrected=False)

    def _line(self, z: Array, goal: Array) -> OutcomeLine:
        x = np.concatenate([z, GOAL_SHARE * goal])
        return linearise(self.trials, self.scales, self.groups, x, self.settings.neighbours)

    def _conditioned(self, z: Array, mean: Array, sigma: Array, line: OutcomeLine) -> tuple[Posterior, OutcomeLine]:
        """The posterior, its mean within the bounds, and the line it was made with; `line` touches at the mean."""
        own = self.scales
        spread = np.minimum(self.settings.trust * (sigma / own.scales), own.high - own.low)
        posterior = self._bounded(mean, spread, line)
        for _ in range(1, self.settings.iterations):
            line = self._line(z, posterior.g)
            posterior = self._bounded(mean, spread, line)
        return posterior, line

    def _bounded(self, mean: Array, spread: Array, line: OutcomeLine) -> Posterior:
        """The posterior with a mean within the bounds: what sticks out is held at its bound, and the rest makes up."""
        posterior = condition(mean, spread, line)
        g = self.scales.within(posterior.g)
        beyond = g != posterior.g
        if beyond.any():
            g = self.scales.within(condition(np.where(beyond, g, mean), np.where(beyond, 0.0, spread), line).g)
        return replace(posterior, g=g)

    def _drawn(self, posterior: Posterior, line: OutcomeLine, trial_id: UUID) -> Array:
        p, q = len(posterior.g), len(self.scales.target)
        seed, first = self.plain.seed, p + 1 + q
        columns = np.concatenate([np.arange(p), p + line.entries])
        u = uniforms(seed, [trial_id], first)[0]
        temperatures = self.settings.temperature
        temperature = temperatures[int(u[p] * len(temperatures))]

        def drawn(u: Array) -> Array:
            return posterior.g + temperature * posterior.deviations(ndtri(u[:, columns]))

        attempt = drawn(np.delete(u, p)[None])
        if not self._inside(attempt)[0]:
            more = uniforms(seed, [trial_id], first + (_ATTEMPTS - 1) * (p + q))[0, first:]
            attempt = np.concatenate([attempt, drawn(more.reshape(-1, p + q))])
        return np.asarray(attempt[int(self._inside(attempt).argmax())])  # none inside: the first

    def _inside(self, goals: Array) -> Array:
        return np.asarray(((goals >= self.scales.low) & (goals <= self.scales.high)).all(axis=1))

    def _goal(self, scaled: Array) -> Array:
        goal = self.scales.middle + self.scales.scales * scaled
        return np.minimum(np.maximum(goal, self.plain.low), self.plain.high)

    def _choice(self, goal: Array, scaled: Array, line: OutcomeLine, *, corrected: bool) -> Choice:
        own = self.scales
        o, sd = line.at(own.within(scaled))
        predicted, deviation = np.full((2, len(own.target)), np.nan)
        tolerance = own.tolerance[line.entries]
        with np.errstate(over="ignore"):
            predicted[line.entries] = own.target[line.entries] + tolerance * o
            deviation[line.entries] = tolerance * sd
        return Choice(goal, np.array(corrected), predicted, deviation)


def _stacked(rows: Sequence[Choice]) -> Choice:
    return Choice(*(np.stack(column) for column in zip(*rows, strict=True)))
