"""What a goal leads to near some states: its outcome, and whether it is executed at all.

    z  (d,)  standardised state      g  (p,)  scaled goal      o  (m,)  outcome in tolerances from the target

Every group of outcome entries has a Gaussian process of the trials nearest to [z, g], hits and misses alike. Refused
goals are data too: one more process learns 0 for what was executed and -2 for what was refused, and its expectation r
tells P(executed) = Phi((r + 0.5) / 0.3). Both are local, so that their cost does not grow with what is stored, and
global while all trials are among the nearest.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from crkr.learner.exploration.local_gp import LocalGP, StepKernel
from crkr.learner.exploration.outcome_index import ObservedTrials
from crkr.learner.exploration.outcome_neighbours import Neighbours, nearest
from crkr.learner.exploration.outcome_posterior import OutcomeLine
from crkr.learner.exploration.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import MOST_NEIGHBOURS, Array, Exploration

__all__ = ["OutcomeModel", "Prospect"]

# Constants found on logs of several tasks; see docs/outcomes.md. Outcomes are in tolerances, steps in the metric.
_OUTCOME: Final = StepKernel(constant=900.0, linear=100.0, bend=100.0, reach=5.0, noise=0.05)
_KERNELS: Final = {
    "gp": _OUTCOME,
    "line": replace(_OUTCOME, bend=0.0),
    # So wide a bend is a straight line and a quadratic term, about as curved as that of "gp" is near by.
    "quadratic": replace(_OUTCOME, bend=25_600.0, reach=20.0, linear=36.0),
}
_SHARE_OF_SIZE: Final = 0.0025  # of an outcome's square that is noise: far misses say little of what is near the target
_REFUSAL: Final = StepKernel(constant=4.0, linear=1.0, bend=4.0, reach=2.0, noise=0.1)
_REFUSED: Final = -2.0
_THRESHOLD: Final = -0.5
_WIDTH: Final = 0.3  # of the probit
_SAFE: Final = -0.05  # r above which a goal need not be moved to be executed


@final
@dataclass(frozen=True, slots=True, eq=False)
class Prospect:
    """What goals should lead to.

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

    @property
    def score(self) -> Array:
        """(b, c) log of how likely a goal is executed and then on target, up to a constant."""
        spread = 1.0 + self.variance
        return np.asarray((-0.5 * (self.o * self.o / spread + np.log(spread))).sum(axis=-1) + self.executed)


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeModel:
    """Fits near b states; made by `near`.

    Attributes:
        centre: (b, p) goals that the fits were made at.
        entries: (m,) which outcome entries are modelled.
        fits: Those of the entries, in order.
        risky: Which states have refused goals near by.
        refusals: The model of these; None where there are none.
        one_sided: (m,) +1 or -1 for entries that may exceed or fall short of their target, else 0.
    """

    centre: Array
    entries: Indices
    fits: tuple[LocalGP, ...]
    risky: Indices
    refusals: LocalGP | None
    one_sided: Array

    @classmethod
    def near(
        cls,
        trials: ObservedTrials,
        scales: OutcomeScales,
        groups: Sequence[int],
        z: Array,
        goals: Array,
        settings: Exploration,
    ) -> OutcomeModel:
        """Fits every group to its `neighbours` trials nearest to the states z (b, d) and goals (b, p), scaled.

        Args:
            trials: What is searched.
            scales: The task's units.
            groups: Which groups are modelled, at least one.
            z: (b, d) states in the metric.
            goals: (b, p) where the fits are best.
            settings: The number of neighbours, and the kind of model.
        """
        x = np.concatenate([z, GOAL_SHARE * goals], axis=1)
        p, count = goals.shape[1], min(settings.neighbours, MOST_NEIGHBOURS)
        kernel = _KERNELS[settings.model]
        fits, together = [], []
        risky, refusals = np.zeros(0, dtype=np.int64), None
        for counted, sets in _sets(trials, groups, count):
            near = _nearest(trials, x, [one[0] for one in sets], *counted)
            for place, one in enumerate(sets):
                D = _joined([found.D[place] for _, found in near])
                if one == [trials.everything]:
                    refused = _joined([part.refused[found.rows[place]] for part, found in near])
                    risky, refusals = _refusals(D, refused, p, counted[1])
                    continue
                entries = np.concatenate([scales.groups[group] for group in one])
                Y = _joined([part.Y[found.rows[place][:, :, None], entries] for part, found in near])
                noise = kernel.noise + _SHARE_OF_SIZE * np.vecdot(Y, Y) / len(entries)
                fits.append(LocalGP.fit(kernel, D, Y, p, noise, counted[1]))
                together.append(entries)
        entries = np.concatenate(together)
        return cls(goals, entries, tuple(fits), risky, refusals, scales.one_sided[entries])

    def prospect(self, goals: Array) -> Prospect:
        """What goals (b, c, p) lead to."""
        steps = GOAL_SHARE * (goals - self.centre[:, None])
        raw, variance = self._expected(steps)
        return Prospect(self._missed(raw), raw, variance, self.executed(goals))

    def _expected(self, steps: Array) -> tuple[Array, Array]:
        """Expectations and variances (b, c, m) at steps (b, c, p)."""
        parts = [fit.at(steps) for fit in self.fits]
        o, variance = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
        return o, variance

    def executed(self, goals: Array) -> Array:
        """(b, c) log P(executed) of goals (b, c, p)."""
        chances = np.zeros(goals.shape[:2])
        if self.refusals is not None:
            steps = GOAL_SHARE * (goals[self.risky] - self.centre[self.risky, None])
            r = self.refusals.mean(steps)[..., 0]
            chances[self.risky] = log_ndtr((r - _THRESHOLD) / _WIDTH)
        return chances

    def line(self, goals: Array) -> OutcomeLine:
        """The entries as straight lines at goals (b, p), and one more entry: to be executed."""
        steps = GOAL_SHARE * (goals - self.centre)
        o, variance = self._expected(steps[:, None])
        b, _, m = o.shape
        p = goals.shape[1]
        all_o, all_J, R = np.zeros((b, m + 1)), np.zeros((b, m + 1, p)), np.ones((b, m + 1))
        missed = self._missed(o[:, 0])
        all_o[:, :m], R[:, :m] = missed, 1.0 + variance[:, 0]
        J = np.concatenate([fit.slope(steps) for fit in self.fits], axis=1)
        all_J[:, :m] = np.where(((self.one_sided != 0) & (missed == 0))[..., None], 0.0, GOAL_SHARE * J)
        if self.refusals is not None:
            r = self.refusals.mean(steps[self.risky, None])[:, 0, 0]
            unsafe = r < _SAFE
            rows = self.risky[unsafe]
            all_o[rows, m] = r[unsafe] / _WIDTH
            all_J[rows, m] = self.refusals.of(np.flatnonzero(unsafe)).slope(steps[rows])[:, 0] * (GOAL_SHARE / _WIDTH)
        return OutcomeLine(goals, all_o, all_J, R)

    def of(self, which: Indices) -> OutcomeModel:
        """That near some of the states."""
        if len(which) == len(self.centre):
            return self
        places = np.flatnonzero(np.isin(self.risky, which)) if self.refusals is not None else self.risky
        risky = np.searchsorted(which, self.risky[places])
        refusals = self.refusals.of(places) if self.refusals is not None and len(places) else None
        fits = tuple(fit.of(which) for fit in self.fits)
        return OutcomeModel(self.centre[which], self.entries, fits, risky, refusals, self.one_sided)

    def _missed(self, o: Array) -> Array:
        return np.where(self.one_sided * o > 0, 0.0, o)


def _refusals(D: Array, refused: NDArray[np.bool_], p: int, former: int) -> tuple[Indices, LocalGP | None]:
    """Which points have a refused goal among their neighbours, and the model there."""
    risky = np.flatnonzero(refused.any(axis=1))
    if not len(risky):
        return risky, None
    y = np.where(refused[risky], _REFUSED, 0.0)[..., None]
    return risky, LocalGP.fit(_REFUSAL, D[risky], y, p, former=former)


def _counted(trials: ObservedTrials, group: int, count: int) -> tuple[int, int]:
    """How many neighbours are of the robot as it is, and of it before a change: at least a half of them."""
    newer = trials.counts[group]
    if trials.former is None:
        return min(count, newer), 0
    older = min(trials.former.counts[group], max(count - newer, count // 2))
    return min(count - older, newer), older


def _nearest(
    trials: ObservedTrials, x: Array, groups: Sequence[int], newer: int, older: int
) -> list[tuple[ObservedTrials, Neighbours]]:
    """The nearest trials of the robot as it is, then those before it changed; each part if any are wanted."""
    parts = ((trials, newer), (trials.former, older))
    return [(part, nearest(part, x, groups, count)) for part, count in parts if part is not None and count]


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    """Arrays (b, k, ...) joined along k."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def _sets(
    trials: ObservedTrials, groups: Sequence[int], count: int
) -> Iterable[tuple[tuple[int, int], list[list[int]]]]:
    """Numbers of neighbours, and for each the groups that have so many; those observed in the same trials together.

    The group of all trials comes last where a goal was refused.
    """
    parts = [trials] if trials.former is None else [trials, trials.former]
    everywhere = [group for group in groups if all(part.hidden[group] is None for part in parts)]
    together = [everywhere] if everywhere else []
    sets: dict[tuple[int, int], list[list[int]]] = {}
    refused = [[trials.everything]] if any(part.any_refused for part in parts) else []
    for one in together + [[group] for group in groups if group not in everywhere] + refused:
        sets.setdefault(_counted(trials, one[0], count), []).append(one)
    return sets.items()
