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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from crkr.learner.exploration.draws import uniforms
from crkr.learner.exploration.explorer import Choice, GaussianExplorer
from crkr.learner.exploration.outcome_index import ObservedTrials
from crkr.learner.exploration.outcome_posterior import OutcomeLine, Posterior, condition, linearise
from crkr.learner.exploration.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array, Exploration, TaskSpec

__all__ = ["OutcomeExplorer"]

_ATTEMPTS: Final = 32
_BLOCK: Final = 32  # states at a time, of whose distances to all trials there is a matrix
_BLOCK_ENTRIES: Final = 10_000  # coordinates of their neighbours; more beside a large matrix of distances, since what
# a process keeps of freed memory is a multiple of the largest piece, and memory that it must ask for again costs most


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
        enough = tuple(group for group in groups if trials.counts[group] >= self.settings.min_trials)
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
        return self._by_blocks(self._best, states, plain.goals, sigmas) if self.groups else plain

    def draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        """Draws from N(g, temperature^2 P'), the conditioned prior; the trial id decides the temperature too."""
        if not self.groups:
            return self.plain.draw(states, means, sigmas, ids)
        return self._by_blocks(self._draw, states, means, sigmas, ids)

    def _by_blocks(self, choose: Callable[..., Choice], states: Array, *rest: Array | Sequence[UUID]) -> Choice:
        """Some states at a time, so that what is computed for them stays in the cache; a single one as one of one."""
        if states.ndim == 1:
            alone = [part[None] if isinstance(part, np.ndarray) else part for part in rest]
            parts: list[Any] = list(choose(states[None], *alone))
            return Choice(*(part[0, ...] for part in parts))
        neighbours = min(self.settings.neighbours, len(self.trials))
        entries = _BLOCK_ENTRIES + 2 * len(self.trials)
        size = max(1, min(_BLOCK, entries // (neighbours * self.trials.X.shape[1])))
        starts = range(0, len(states), size)
        blocks = [choose(*(part[start : start + size] for part in (states, *rest))) for start in starts]
        return Choice(*map(np.concatenate, zip(*blocks, strict=True)))

    def _best(self, states: Array, plain: Array, sigmas: Array) -> Choice:
        z, means = self.scales.metric.standardise(states), self.scales.scaled(plain)
        line = self._line(z, means)
        fine = line.worst <= self.settings.gate
        if fine.all():
            return self._choice(plain, means, line, corrected=False)
        if not fine.any():
            return self._corrected(z, means, sigmas, line)
        off = np.flatnonzero(~fine)
        parts: list[Any] = list(self._choice(plain.copy(), means, line, corrected=False))
        for whole, part in zip(parts, self._corrected(z[off], means[off], sigmas[off], line.of(off)), strict=True):
            whole[off] = part
        return Choice(*parts)

    def _corrected(self, z: Array, means: Array, sigmas: Array, line: OutcomeLine) -> Choice:
        posterior, line = self._conditioned(z, means, sigmas, line)
        return self._choice(self._goals(posterior.g), posterior.g, line, corrected=True)

    def _draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        z, centres = self.scales.metric.standardise(states), self.scales.scaled(means)
        posterior, line = self._conditioned(z, centres, sigmas, self._line(z, centres))
        drawn = self._drawn(posterior, line, ids)
        return self._choice(self._goals(drawn), drawn, line, corrected=False)

    def _line(self, z: Array, goals: Array) -> OutcomeLine:
        x = np.concatenate([z, GOAL_SHARE * goals], axis=1)
        return linearise(self.trials, self.scales, self.groups, x, self.settings.neighbours)

    def _conditioned(self, z: Array, means: Array, sigmas: Array, line: OutcomeLine) -> tuple[Posterior, OutcomeLine]:
        """The posterior, its mean within the bounds, and the line it was made with; `line` touches at the means."""
        own = self.scales
        spread = np.minimum(self.settings.trust * (sigmas / own.scales), own.high - own.low)
        posterior = self._bounded(means, spread, line)
        for _ in range(1, self.settings.iterations):
            line = self._line(z, posterior.g)
            posterior = self._bounded(means, spread, line)
        return posterior, line

    def _bounded(self, means: Array, spread: Array, line: OutcomeLine) -> Posterior:
        """The posterior with a mean within the bounds: what sticks out is held at its bound, and the rest makes up."""
        posterior = condition(means, spread, line)
        g = self.scales.within(posterior.g)
        beyond = g != posterior.g
        if beyond.any():
            rows = np.flatnonzero(beyond.any(axis=1))
            held, fixed = beyond[rows], g[rows]
            means, spread = np.where(held, fixed, means[rows]), np.where(held, 0.0, spread[rows])
            g[rows] = self.scales.within(condition(means, spread, line.of(rows)).g)
        return replace(posterior, g=g)

    def _drawn(self, posterior: Posterior, line: OutcomeLine, ids: Sequence[UUID]) -> Array:
        p, q = posterior.g.shape[1], len(self.scales.target)
        seed, first = self.plain.seed, p + 1 + q
        columns = np.concatenate([np.arange(p), p + line.entries])
        u = uniforms(seed, ids, first)
        temperatures = np.array(self.settings.temperature)[(u[:, p] * len(self.settings.temperature)).astype(int)]

        def drawn(which: Indices, u: Array) -> Array:
            deviations = posterior.of(which).deviations(ndtri(u[:, :, columns]))
            return np.asarray(posterior.g[which, None] + temperatures[which, None, None] * deviations)

        goals = drawn(np.arange(len(u)), np.delete(u, p, axis=1)[:, None])[:, 0]
        out = np.flatnonzero(~self._inside(goals))
        if len(out):
            more = uniforms(seed, [ids[row] for row in out.tolist()], first + (_ATTEMPTS - 1) * (p + q))[:, first:]
            attempts = drawn(out, more.reshape(len(out), _ATTEMPTS - 1, p + q))
            inside = self._inside(attempts)
            found = inside.any(axis=1)  # none inside: the first attempt stays
            goals[out[found]] = attempts[found, inside.argmax(axis=1)[found]]
        return goals

    def _inside(self, goals: Array) -> NDArray[np.bool_]:
        return np.asarray(((goals >= self.scales.low) & (goals <= self.scales.high)).all(axis=-1))

    def _goals(self, scaled: Array) -> Array:
        goals = self.scales.middle + self.scales.scales * scaled
        return np.minimum(np.maximum(goals, self.plain.low), self.plain.high)

    def _choice(self, goals: Array, scaled: Array, line: OutcomeLine, *, corrected: bool) -> Choice:
        own = self.scales
        o, sd = line.at(own.within(scaled))
        predicted, deviation = np.full((2, len(goals), len(own.target)), np.nan)
        tolerance = own.tolerance[line.entries]
        with np.errstate(over="ignore"):
            predicted[:, line.entries] = own.target[line.entries] + tolerance * o
            deviation[:, line.entries] = tolerance * sd
        return Choice(goals, np.full(len(goals), corrected), predicted, deviation)
