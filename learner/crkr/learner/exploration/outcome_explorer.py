"""Outcome-guided exploration: the GP distribution over goals, conditioned on the target outcome.

The prior N(m, (trust sigma)^2) from the regression of successes is conditioned on a predicted outcome at the target, by
Kalman updates around successive goals. Misses teach as much as hits, and noise remains in directions of the goal that
do not change the outcome. Learned forward models guide contextual policy search in [Kupcsik2013]; here the regression's
uncertainty bounds how far they are trusted.

`draw` samples the conditioned prior N(g, P'), at one of several temperatures, until a goal is within the bounds and
likely to be executed. `best` takes the highest score among the mean, g and draws from a fixed table.

After the p uniforms of a trial (see draws.py) the next one chooses its temperature; then come `_ATTEMPTS` acceptances,
and p + q + 1 numbers for each attempt.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final, final
from uuid import UUID

import numpy as np
from scipy.special import ndtri

from crkr.learner.exploration.draws import uniforms
from crkr.learner.exploration.explorer import Choice, GaussianExplorer
from crkr.learner.exploration.outcome_index import ObservedTrials
from crkr.learner.exploration.outcome_model import OutcomeModel, Prospect
from crkr.learner.exploration.outcome_posterior import OutcomeLine, Posterior, condition_within
from crkr.learner.exploration.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.learner.exploration.prequential import Calibration, DeferredCalibration, features
from crkr.learner.exploration.tried_goals import better_starts, least_missing
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array, Exploration, TaskSpec

__all__ = ["OutcomeExplorer"]

_ATTEMPTS: Final = 16
_BLOCK: Final = 32  # states per batch, as a numpy call costs as much as one state's matrices
_STILL: Final = 0.02  # scales; updates end when one moves the goal by less
_REFIT: Final = 0.25  # share of the distance of the farthest neighbour, beyond which a goal's model is refitted
_SAFE: Final = np.log(0.9)  # P(executed) above which a mean on target needs no update
_UNKNOWN: Final = Calibration()
_AROUND: Final = 0.5  # scales by which a goal that was tried may move
_LOOSE: Final = 2.0  # scales by which a goal may move at least, once the robot has changed
_WIDTHS: Final = (0.1, 0.3, 1.0)  # widths of the candidates, in standard deviations of P'


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeExplorer:
    """Goals conditioned on the target outcome; plain ones until enough outcomes were observed. Make it with `of`.

    Attributes:
        plain: Answers until then, and proposes the goals that are corrected.
        settings: The task's `exploration`.
        scales: The task's units.
        trials: The trials so far.
        groups: Groups of outcomes observed in at least `min_trials` trials; others are not modelled.
        calibration: How reliable its model is.
        changed: Whether the robot has changed since the task began.
    """

    plain: GaussianExplorer
    settings: Exploration
    scales: OutcomeScales
    trials: ObservedTrials
    groups: tuple[int, ...]
    calibration: Calibration | DeferredCalibration = _UNKNOWN
    changed: bool = False

    @classmethod
    def of(cls, spec: TaskSpec, scales: OutcomeScales, trials: ObservedTrials) -> OutcomeExplorer:
        """The explorer of a new task; `with_trials` makes later ones."""
        return cls(GaussianExplorer.of(spec), spec.exploration, scales, trials, ()).with_trials(trials)

    def with_trials(
        self,
        trials: ObservedTrials,
        calibration: Calibration | DeferredCalibration = _UNKNOWN,
        *,
        changed: bool = False,
    ) -> OutcomeExplorer:
        """The same with other trials and the calibration they give."""
        enough = trials.enough(self.settings.min_trials)
        return replace(self, trials=trials, groups=enough, calibration=calibration, changed=changed)

    @property
    def guides(self) -> bool:
        """Whether enough outcomes were observed."""
        return bool(self.groups)

    def prepare(self, trials: int = 0) -> bool:
        """Work on the calibration of the model."""
        return not self.guides or self.calibration.advance(trials)

    @property
    def searched(self) -> int:
        """The newest trials, once enough outcomes were observed: all of them are compared."""
        return len(self.trials.newest()) if self.guides else 0

    def best_tried(self, states: Array) -> Array:
        """(p,) or (b, p) of the newest goals, those whose outcome here is probably nearest to the target.

        Trials are compared by squared outcome, distance of the state, and a penalty for unobserved entries.
        """
        known = self.trials if len(self.trials) or self.trials.former is None else self.trials.former
        entries = np.concatenate([self.scales.groups[group] for group in self.groups])
        z = self.scales.metric.standardise(np.atleast_2d(states))
        goals, _ = least_missing(known.newest(), entries, self.scales.one_sided[entries], z)
        return self._goals(goals).reshape(*states.shape[:-1], -1)

    def best(self, states: Array, means: Array, sigmas: Array) -> Choice:
        """The plain goals where they are good enough, otherwise the candidates of highest score.

        A plain goal is good enough if every entry of its predicted outcome is within `gate` tolerances and it is likely
        to be executed.
        """
        if not self.guides:
            return self.plain.best(states, means, sigmas)
        return self._by_blocks(self._best, states, means, sigmas)

    def draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        """Draws from N(g, temperature^2 P'), the conditioned prior; the trial id also decides the temperature."""
        if not self.guides:
            return self.plain.draw(states, means, sigmas, ids)
        return self._by_blocks(self._draw, states, means, sigmas, ids)

    def _by_blocks(self, choose: Callable[..., Choice], states: Array, *rest: Array | Sequence[UUID]) -> Choice:
        """States in batches, to bound memory; a single state is a batch of one."""
        if states.ndim == 1:
            alone = [part[None] if isinstance(part, np.ndarray) else part for part in rest]
            parts: list[Any] = list(choose(states[None], *alone))
            return Choice(*(part[0, ...] for part in parts))
        starts = range(0, len(states), _BLOCK)
        blocks = [choose(*(part[start : start + _BLOCK] for part in (states, *rest))) for start in starts]
        return Choice(*map(np.concatenate, zip(*blocks, strict=True)))

    def _best(self, states: Array, means: Array, sigmas: Array) -> Choice:
        z, m, spread = self._prior(states, means, sigmas)
        model = self._model(z, m)
        seen = Prospect.empty(len(m), len(model.entries))
        fine = np.abs(model.missed(m)).max(axis=1) <= self.settings.gate
        if fine.any():
            rows = fine.nonzero()[0]
            first = model.of(rows).prospect(m[rows, None]).first()
            seen.put(rows, first)
            fine[rows] = first.executed >= _SAFE
        off, scaled, corrected = (~fine).nonzero()[0], m.copy(), np.zeros(len(m), dtype=np.bool_)
        if len(off):
            for rows, posterior, near in self._conditioned(z[off], m[off], spread[off], model.of(off)):
                candidates = self._candidates(m[off[rows]], posterior)
                prospect = near.prospect(candidates)
                chosen, where = prospect.score.argmax(axis=1), off[rows]
                scaled[where], corrected[where] = candidates[np.arange(len(rows)), chosen], chosen != 0
                seen.put(where, prospect.chosen(chosen))
        goals = self._goals(scaled)
        plain = np.clip(means, self.plain.low, self.plain.high)
        goals[~corrected] = plain[~corrected]
        return self._choice(goals, corrected, model.entries, seen)

    def _draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        z, m, spread = self._prior(states, means, sigmas)
        model = self._model(z, m)
        drawn, seen = np.empty_like(m), Prospect.empty(len(m), len(model.entries))
        for rows, posterior, near in self._conditioned(z, m, spread, model):
            drawn[rows] = goals = self._drawn(posterior, near, [ids[row] for row in rows.tolist()])
            seen.put(rows, near.prospect(goals[:, None]).first())
        return self._choice(self._goals(drawn), np.zeros(len(m), dtype=np.bool_), model.entries, seen)

    def _prior(self, states: Array, means: Array, sigmas: Array) -> tuple[Array, Array, Array]:
        """States in the metric, scaled means, and how far the means may move."""
        own = self.scales
        spread = self.settings.trust * (sigmas / own.scales)
        if self.changed:
            spread = np.maximum(spread, _LOOSE)
        spread = np.minimum(spread, own.high - own.low)
        return own.metric.standardise(states), own.scaled(means), spread

    def _model(self, z: Array, goals: Array) -> OutcomeModel:
        return OutcomeModel.near(self.trials, self.scales, self.groups, z, goals, self.settings)

    def _conditioned(
        self, z: Array, means: Array, spread: Array, model: OutcomeModel
    ) -> Iterator[tuple[Indices, Posterior, OutcomeModel]]:
        """Posteriors with means within the bounds, and their models; `model` is centred at the means.

        Each starts from its mean or, where that should miss by far, from a goal that was tried, whichever leads to a
        higher score. There are several parts, each with its rows.
        """
        line = model.line(means)
        parts = list(self._refined(z, means, spread, model, line))
        lost, starts = better_starts(self.trials, model, line, z)
        if len(lost):
            anew, narrow = self._model(z[lost], starts), np.minimum(_AROUND, self.scales.high - self.scales.low)
            others = self._refined(z[lost], starts, np.tile(narrow, (len(lost), 1)), anew, anew.line(starts))
            parts += [(lost[rows], posterior, near) for rows, posterior, near in others]
        score = np.full((len(parts), len(z)), -np.inf)
        if len(lost):
            for place, (rows, posterior, near) in enumerate(parts):
                score[place, rows] = near.prospect(posterior.g[:, None]).score[:, 0]
        chosen = score.argmax(axis=0)
        for place, (rows, posterior, near) in enumerate(parts):
            kept = np.flatnonzero(chosen[rows] == place) if len(lost) else np.arange(len(rows))
            if len(kept):
                yield rows[kept], posterior.of(kept), near.of(kept)

    def _refined(
        self, z: Array, means: Array, spread: Array, model: OutcomeModel, line: OutcomeLine
    ) -> Iterator[tuple[Indices, Posterior, OutcomeModel]]:
        """Posteriors of these means, whose model has this line. Where other trials are nearest it is refitted."""
        posterior = condition_within(means, spread, line, self.scales)
        step = GOAL_SHARE * (posterior.g - means)
        away = np.vecdot(step, step) > _REFIT**2 * model.farthest
        near, far = np.flatnonzero(~away), np.flatnonzero(away)
        if len(near):
            local = model.of(near)
            yield near, self._updated(means[near], spread[near], posterior.of(near), means[near], local), local
        if len(far):
            means, spread, start = means[far], spread[far], posterior.g[far]
            refit = self._model(z[far], start)
            posterior = condition_within(means, spread, refit.line(start), self.scales)
            yield far, self._updated(means, spread, posterior, start, refit), refit

    def _updated(
        self, means: Array, spread: Array, posterior: Posterior, start: Array, model: OutcomeModel
    ) -> Posterior:
        """Repeats updates, each linearised at the previous goal, until the goal stops; the first one is given."""
        moving = np.flatnonzero(np.abs(posterior.g - start).max(axis=1) >= _STILL)
        for _ in range(1, self.settings.iterations):
            if not len(moving):
                break
            before = posterior.g[moving]
            line = model.of(moving).line(before)
            after = condition_within(means[moving], spread[moving], line, self.scales)
            if len(moving) == len(means):
                posterior = after
            else:
                posterior.put(moving, after)
            moving = moving[np.abs(after.g - before).max(axis=1) >= _STILL]
        return posterior

    def _candidates(self, means: Array, posterior: Posterior) -> Array:
        """(b, 2 + candidates, p): the mean, the posterior's mean, and draws from it within the bounds."""
        m = posterior.R.shape[1]
        table, widths = _normals(self.settings.candidates, means.shape[1], m)
        drawn = posterior.g[:, None] + widths * posterior.deviations(table)
        return np.concatenate([means[:, None], posterior.g[:, None], self.scales.within(drawn)], axis=1)

    def _drawn(self, posterior: Posterior, model: OutcomeModel, ids: Sequence[UUID]) -> Array:
        b, p = posterior.g.shape
        q = len(self.scales.target) + 1
        u = uniforms(self.plain.seed, ids, p + 1 + _ATTEMPTS * (1 + p + q))
        temperatures = np.array(self.settings.temperature)[(u[:, p] * len(self.settings.temperature)).astype(int)]
        accepted, u = u[:, p + 1 : p + 1 + _ATTEMPTS], u[:, p + 1 + _ATTEMPTS :].reshape(b, _ATTEMPTS, p + q)
        columns = np.concatenate([np.arange(p), p + model.entries, [p + q - 1]])
        goals = posterior.g[:, None] + temperatures[:, None, None] * posterior.deviations(ndtri(u[:, :, columns]))
        inside = ((goals >= self.scales.low) & (goals <= self.scales.high)).all(axis=2)
        inside[~inside.any(axis=1), 0] = True  # none is: the first, clipped to the bounds
        goals = self.scales.within(goals)
        chances = np.where(inside, model.executed(goals), -np.inf)
        taken = inside & (np.log(accepted) <= chances)
        chosen = np.where(taken.any(axis=1), taken.argmax(axis=1), chances.argmax(axis=1))
        return np.asarray(goals[np.arange(b), chosen])

    def _goals(self, scaled: Array) -> Array:
        goals = self.scales.middle + self.scales.scales * scaled
        return np.minimum(np.maximum(goals, self.plain.low), self.plain.high)

    def _choice(self, goals: Array, corrected: Any, entries: Indices, seen: Prospect) -> Choice:
        """The goals with their predicted outcomes (b, m) and P(success), NaN if unknown."""
        own, calibration = self.scales, self.calibration.get()
        predicted, deviation = np.full((2, len(goals), len(own.target)), np.nan)
        with np.errstate(over="ignore"):
            predicted[:, entries] = own.target[entries] + own.tolerance[entries] * seen.raw
            deviation[:, entries] = own.tolerance[entries] * np.sqrt(seen.variance)
            if calibration.spread is not None:
                deviation *= calibration.spread
        curve = calibration.curve
        chance = np.full(len(goals), np.nan) if curve is None else curve.at(features(seen))
        return Choice(goals, corrected, predicted, deviation, chance)


@lru_cache(maxsize=64)
def _normals(count: int, p: int, m: int) -> tuple[Array, Array]:
    """A fixed table of standard normal numbers (1, count, p + m), and the widths (count, 1) of the candidates."""
    table = ndtri(uniforms(0, [UUID(int=row) for row in range(count)], p + m))[None]
    widths = np.resize(_WIDTHS, count)[:, None]
    for array in (table, widths):
        array.setflags(write=False)
    return table, widths
