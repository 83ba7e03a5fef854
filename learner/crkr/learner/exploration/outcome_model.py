"""Predicts the outcome of goals near some states, and whether a goal is executed at all.

    z  (d,)  standardised state      g  (p,)  scaled goal      o  (m,)  outcome in tolerances from the target

Each group of outcome entries has a Gaussian process on the trials nearest to [z, g], hits and misses. Refused goals are
data too, for one more process (see `refusals`). Both are local, so that their cost does not grow with the number of
trials, and global while all trials are among the nearest.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.exploration.local_gp import LocalGP, StepKernel
from crkr.learner.exploration.outcome_index import ObservedTrials
from crkr.learner.exploration.outcome_neighbours import Neighbours, nearest
from crkr.learner.exploration.outcome_posterior import OutcomeLine
from crkr.learner.exploration.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.learner.exploration.refusals import Refusals, RefusedNear
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import MOST_NEIGHBOURS, Array, Exploration

__all__ = ["OutcomeModel", "Prospect"]

# Tuned on logs of several tasks, see docs/outcomes.md. Outcomes are in tolerances, steps in the metric.
_OUTCOME: Final = StepKernel(constant=900.0, linear=100.0, bend=100.0, reach=5.0, noise=0.05)
_KERNELS: Final = {
    "gp": _OUTCOME,
    "line": replace(_OUTCOME, bend=0.0),
    # A bend this wide is a straight line plus a quadratic term, about as curved as "gp" near by.
    "quadratic": replace(_OUTCOME, bend=25_600.0, reach=20.0, linear=36.0),
}
_SHARE_OF_SIZE: Final = 0.0025  # share of a squared outcome that is noise: far misses say little about the target
_NOTHING: Final = Refusals(np.zeros(0, dtype=np.int64), None)


@final
@dataclass(frozen=True, slots=True, eq=False)
class Prospect:
    """Predicted outcomes of goals.

    Attributes:
        o: (b, c, m) expected outcomes; 0 where a one-sided target is met.
        raw: (b, c, m) expected outcomes.
        variance: (b, c, m) of an observation.
        executed: (b, c) log P(executed).
    """

    o: Array
    raw: Array
    variance: Array
    executed: Array

    @classmethod
    def empty(cls, b: int, m: int) -> Prospect:
        """For `put`, with one goal of each state."""
        return cls(np.empty((b, m)), np.empty((b, m)), np.empty((b, m)), np.empty(b))

    def first(self) -> Prospect:
        """Predicted outcomes of the first goal of each state."""
        return Prospect(self.o[:, 0], self.raw[:, 0], self.variance[:, 0], self.executed[:, 0])

    def chosen(self, which: Indices) -> Prospect:
        """Predicted outcomes of one goal of each state (b,), without the axis of goals."""
        row = np.arange(len(which))
        return Prospect(*(part[row, which] for part in (self.o, self.raw, self.variance, self.executed)))

    def put(self, which: Indices, other: Prospect) -> None:
        """Replaces the rows of some states by those of `other`."""
        self.o[which], self.raw[which] = other.o, other.raw
        self.variance[which], self.executed[which] = other.variance, other.executed

    @property
    def score(self) -> Array:
        """(b, c) log probability that a goal is executed and on target, up to a constant."""
        spread = 1.0 + self.variance
        return np.asarray((-0.5 * (self.o * self.o / spread + np.log(spread))).sum(axis=-1) + self.executed)


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeModel:
    """Fits near b states; made by `near`.

    Attributes:
        centre: (b, p) goals that the fits were made at.
        entries: (m,) outcome entries that are modelled.
        fits: One fit for each number of nearby trials, shared by the sets of entries observed in that many.
        places: Positions of the entries in the output of the fits.
        refusals: The model of refusals.
        farthest: (b,) squared distance of the farthest neighbour, least over the fits.
        one_sided: (m,) +1 or -1 for entries that may exceed or fall short of their target, else 0; None: all are 0.
    """

    centre: Array
    entries: Indices
    fits: tuple[LocalGP, ...]
    places: tuple[Indices, ...]
    refusals: Refusals
    farthest: Array
    one_sided: Array | None

    @classmethod
    def near(
        cls,
        trials: ObservedTrials,
        scales: OutcomeScales,
        groups: Sequence[int],
        z: Array,
        goals: Array,
        settings: Exploration,
        later: list[RefusedNear] | None = None,
    ) -> OutcomeModel:
        """Fits every group to its `neighbours` trials nearest to the states z (b, d) and goals (b, p), scaled.

        Args:
            trials: What is searched.
            scales: The task's units.
            groups: Groups to model, at least one.
            z: (b, d) states in the metric.
            goals: (b, p) centres of the fits.
            settings: The number of neighbours, and the kind of model.
            later: Refusals near the states are added here, rather than modelled; None: they are modelled.
        """
        x = np.concatenate([z, GOAL_SHARE * goals], axis=1)
        p, count = goals.shape[1], min(settings.neighbours, MOST_NEIGHBOURS)
        kernel = _KERNELS[settings.model]
        every: list[tuple[int, ...]] = []
        fits, places, refusals = [], [], _NOTHING
        parts = [trials] if trials.former is None else [trials, trials.former]
        any_refused = any(part.any_refused for part in parts)
        everywhere = {one for one in (*groups, trials.everything) if all(part.hidden[one] is None for part in parts)}
        farthest = np.empty(0)
        for counted, searched in _sets(trials, groups, everywhere, any_refused, count):
            near = _nearest(trials, x, [one[0] for one in searched], *counted)
            D, squared = _joined([found.D for _, found in near]), _joined([found.squared for _, found in near])
            least = squared.max(axis=2).min(axis=0)
            farthest = np.minimum(farthest, least) if len(farthest) else least
            if any_refused and searched[0][0] in everywhere:
                refused = _joined([part.refused[found.rows[0]] for part, found in near], 1)
                refused_near = RefusedNear(D[0], refused, p, counted[1])
                if later is None:
                    refusals = refused_near.model()
                else:
                    later.append(refused_near)
            first = int(searched[0] == (trials.everything,))  # the group of all trials is searched for refusals only
            sets = tuple(searched[first:])
            if not sets:
                continue
            own = _columns(scales, sets)
            q = trials.Y.shape[1]
            Y = _joined([part.Y.take(found.rows[first:, ..., None] * q + own.table) for part, found in near])
            for place, unused in own.unused:
                Y[place, ..., -unused:] = 0.0
            noise = kernel.noise + own.shares * np.vecdot(Y, Y)
            D, Y, noise = (array.reshape(-1, *array.shape[2:]) for array in (D[first:], Y, noise))
            fits.append(LocalGP.fit(kernel, D, Y, p, noise, counted[1]))
            every += sets
            places.append(own.places)
        entries, sided = _entries(scales, tuple(every))
        return cls(goals, entries, tuple(fits), tuple(places), refusals, farthest, sided)

    def missed(self, goals: Array) -> Array:
        """(b, m) expected outcomes of goals (b, p), as `Prospect.o`."""
        steps = GOAL_SHARE * (goals - self.centre)[:, None]
        return self._missed(self._of_entries([fit.mean(_for_each(steps, fit)) for fit in self.fits], 2)[:, 0])

    def prospect(self, goals: Array) -> Prospect:
        """Predicts the outcomes of goals (b, c, p)."""
        steps = GOAL_SHARE * (goals - self.centre[:, None])
        raw, variance = self._expected(steps)
        return Prospect(self._missed(raw), raw, variance, self.refusals.executed(steps))

    def _expected(self, steps: Array) -> tuple[Array, Array]:
        """Expectations and variances (b, c, m) at steps (b, c, p)."""
        raw, variance = zip(*(fit.at(_for_each(steps, fit)) for fit in self.fits), strict=True)
        return self._of_entries(raw, 2), self._of_entries(variance, 2)

    def _of_entries(self, parts: Sequence[Array], axis: int = 1) -> Array:
        """Of all entries, from the output of the fits: (b, m) or (b, m, p) from (s b, *) or (s b, *, p).

        With axis 2 (b, c, m) from (s b, c, *).
        """
        b, each = len(self.centre), []
        for part, places in zip(parts, self.places, strict=True):
            side_by_side = part
            if len(part) != b:
                sets = part.reshape(-1, b, *part.shape[1:])
                beside = sets.swapaxes(0, 1) if axis == 1 else sets.transpose(1, 2, 0, 3)
                side_by_side = beside.reshape(b, *part.shape[1:axis], -1, *part.shape[axis + 1 :])
            whole = len(places) == side_by_side.shape[axis]
            each.append(side_by_side if whole else side_by_side.take(places, axis=axis))
        return each[0] if len(each) == 1 else np.concatenate(each, axis=axis)

    def executed(self, goals: Array) -> Array:
        """(b, c) log P(executed) of goals (b, c, p)."""
        return self.refusals.executed(GOAL_SHARE * (goals - self.centre[:, None]))

    def line(self, goals: Array) -> OutcomeLine:
        """The entries as straight lines at goals (b, p), and one more entry: to be executed."""
        steps = GOAL_SHARE * (goals - self.centre)
        means, variances, slopes = zip(*(fit.line(_for_each(steps, fit)) for fit in self.fits), strict=True)
        o, (b, p), m = self._of_entries(means), goals.shape, len(self.entries)
        all_o, all_J, R = np.zeros((b, m + 1)), np.zeros((b, m + 1, p)), np.zeros((b, m + 1))
        all_o[:, :m], R[:, :m] = self._missed(o), self._of_entries(variances)
        R += 1.0
        np.multiply(self._of_entries(slopes), GOAL_SHARE, out=all_J[:, :m])
        if self.one_sided is not None:
            all_J[:, :m][(self.one_sided != 0) & (all_o[:, :m] == 0)] = 0.0
        self.refusals.put_line(steps, all_o[:, m], all_J[:, m])
        return OutcomeLine(goals, all_o, all_J, R)

    def state_slope(self) -> Array:
        """(b, m, d) change of the expected outcomes at the centre with a step of the state in the metric."""
        return self._of_entries([fit.state_slope() for fit in self.fits])

    def of(self, which: Indices) -> OutcomeModel:
        """The model near some of the states."""
        if len(which) == len(self.centre):
            return self
        b = len(self.centre)
        fits = tuple(fit.of((np.arange(0, len(fit.D), b)[:, None] + which).ravel()) for fit in self.fits)
        parts = fits, self.places, self.refusals.of(which), self.farthest[which]
        return OutcomeModel(self.centre[which], self.entries, *parts, self.one_sided)

    def _missed(self, o: Array) -> Array:
        return o if self.one_sided is None else np.where(self.one_sided * o > 0, 0.0, o)


class _Columns(NamedTuple):
    """Where the outcomes of s sets of entries are, side by side.

    Attributes:
        table: (s, 1, 1, w) entries; those of a shorter set repeat.
        unused: The shorter sets, each with its number of repeated entries.
        shares: (s, 1, 1) shares of a squared outcome that are noise.
        places: (m,) positions of all entries among the s w ones.
    """

    table: Indices
    unused: tuple[tuple[int, int], ...]
    shares: Array
    places: Indices


@lru_cache(maxsize=64)
def _columns(scales: OutcomeScales, sets: tuple[tuple[int, ...], ...]) -> _Columns:
    each = [_entries(scales, (one,))[0] for one in sets]
    w = max(map(len, each))
    unused = tuple((place, w - len(own)) for place, own in enumerate(each) if len(own) < w)
    shares = np.array([_SHARE_OF_SIZE / len(own) for own in each])
    places = np.concatenate([place * w + np.arange(len(own)) for place, own in enumerate(each)])
    table = np.stack([np.resize(own, w) for own in each])
    return _Columns(table[:, None, None], unused, shares[:, None, None], places)


@lru_cache(maxsize=64)
def _entries(scales: OutcomeScales, sets: tuple[tuple[int, ...], ...]) -> tuple[Indices, Array | None]:
    """(m,) entries of the sets in order, and (m,) their sides; None: none is one-sided."""
    entries = np.concatenate([scales.groups[group] for one in sets for group in one])
    sides = scales.one_sided[entries]
    return entries, sides if sides.any() else None


def _for_each(steps: Array, fit: LocalGP) -> Array:
    """Steps (b, ...), repeated for each set of entries of a fit."""
    sets = len(fit.D) // len(steps)
    return steps if sets == 1 else np.concatenate([steps] * sets)


def _counted(trials: ObservedTrials, group: int, count: int) -> tuple[int, int]:
    """Numbers of neighbours from after and before a change of the robot; at least half are from after it."""
    newer = trials.counts[group]
    if trials.former is None:
        return min(count, newer), 0
    older = min(trials.former.counts[group], max(count - newer, count // 2))
    return min(count - older, newer), older


def _nearest(
    trials: ObservedTrials, x: Array, groups: Sequence[int], newer: int, older: int
) -> list[tuple[ObservedTrials, Neighbours]]:
    """The nearest trials since the robot changed, then those before; either part may be empty."""
    parts = ((trials, newer), (trials.former, older))
    return [(part, nearest(part, x, groups, count)) for part, count in parts if part is not None and count]


def _joined(parts: list[NDArray[Any]], axis: int = 2) -> NDArray[Any]:
    """Arrays (s, b, k, ...) joined along k, or (b, k, ...) along axis 1."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=axis)


def _sets(
    trials: ObservedTrials, groups: Sequence[int], everywhere: Set[int], any_refused: bool, count: int
) -> Iterable[tuple[tuple[int, int], list[tuple[int, ...]]]]:
    """Numbers of neighbours, each with its groups; groups observed in all trials come first, together.

    The group of all trials is added where a goal was refused and no other group was always observed.
    """
    whole = tuple(group for group in groups if group in everywhere)
    together = [whole] if whole else [(trials.everything,)] if any_refused else []
    sets: dict[tuple[int, int], list[tuple[int, ...]]] = {}
    for one in together + [(group,) for group in groups if group not in everywhere]:
        sets.setdefault(_counted(trials, one[0], count), []).append(one)
    return sets.items()
