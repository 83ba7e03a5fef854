"""Predictions for each trial before it was learned from: prequential predictions [Dawid1984].

They calibrate the outcome model: a success curve and the spread of predicted outcomes are fitted to them, and their
residuals show a change of the robot. A trial's prediction depends on earlier trials of the log only, so the grouping of
reports does not matter.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final, NamedTuple, final

import numpy as np

from crkr.learner.exploration.outcome_index import ObservedTrials
from crkr.learner.exploration.outcome_model import OutcomeModel, Prospect
from crkr.learner.exploration.outcome_scales import GOAL_SHARE, OutcomeScales
from crkr.learner.exploration.refusals import RefusedNear
from crkr.learner.exploration.success import SuccessCurve
from crkr.protocol import Array, Exploration

__all__ = ["LOOKED_BACK", "Calibration", "DeferredCalibration", "PrequentialRecord", "features"]

_Step = tuple[ObservedTrials, ObservedTrials]
_KEPT: Final = 400
_FITTED: Final = 200  # newest trials that the calibration is fitted to
_EVERY: Final = 10  # trials between two fits of it
LOOKED_BACK: Final = _FITTED + _EVERY  # trials that decide the current calibration
_PRIOR: Final = np.array([2.0, 1.0, 0.0, 1.0])  # of the curve's weights
_SPREAD: Final = 1.5
_FEWEST: Final = 20  # residuals of an entry; with fewer, its standard deviation is not calibrated
_NORMAL_90: Final = 1.6449
_SPREADS: Final = (0.1, 10.0)

# The CUSUM of the squared standardised residuals. Constants as in docs/outcomes.md.
_RESIDUAL_NOISE: Final = 0.05
_LARGEST: Final = 9.0
_NEWEST: Final = 20  # newest residuals, left out of the usual level
_SETTLED: Final = 30  # residuals of the usual level before the watch begins
_ALLOWANCE: Final = 1.5
_LEAST_USUAL: Final = 0.5
_ALARM: Final = 20.0


@final
@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The calibration of the outcome model.

    Attributes:
        curve: P(success) of a predicted outcome; None: not known yet.
        spread: (q,) factors on the predicted standard deviations; None: not calibrated.
    """

    curve: SuccessCurve | None = None
    spread: Array | None = None

    def get(self) -> Calibration:
        """Itself."""
        return self

    def advance(self, trials: int) -> bool:
        """True: there is nothing left to compute."""
        del trials  # unused
        return True


class _Expected(NamedTuple):
    """One trial's record.

    Attributes:
        features: (f,) of the success curve; the last of them is computed when the curve is fitted.
        success: Whether the trial succeeded.
        off: (q,) standardised residuals of the outcome; NaN for entries not both predicted and observed.
    """

    features: Array
    success: bool
    off: Array


def features(seen: Prospect) -> Array:
    """(b, c, 4) features of the success curve."""
    spread = 1.0 + seen.variance
    missed, unsure = -0.5 * (seen.o**2 / spread).sum(axis=-1), -0.5 * np.log(spread).sum(axis=-1)
    found = np.ones((*missed.shape, 4))
    found[..., 1], found[..., 2], found[..., 3] = missed, unsure, seen.executed
    return found


@final
class PrequentialRecord:
    """Predictions and results of the newest trials.

    Args:
        settings: The task's `exploration`.
        scales: Its units.
        filling: First trials of a task, whose goals fill the space. No residual of theirs counts as drift: the model is
            young, and their goals are unlike those that follow.
        count: Earlier trials, no longer considered.

    Attributes:
        calibration: The calibration so far.
    """

    def __init__(self, settings: Exploration, scales: OutcomeScales, filling: int = 0, count: int = 0) -> None:
        self._settings, self._scales, self._filling, self._count = settings, scales, filling, count
        self._record: deque[_Expected] = deque(maxlen=_FITTED)
        self._refused: list[tuple[Array, RefusedNear]] = []  # features whose last one is not computed yet
        self._residuals: deque[float] = deque(maxlen=_KEPT)  # known residuals only
        self._cusum = 0.0
        self.calibration = Calibration()

    def extend(self, each: Iterable[_Step]) -> None:
        """Add trials, each as two snapshots: the trials that predict it, and the same with it as the last one."""
        for before, after in each:
            if not after.shown[-1]:
                self._add(before, after)

    @property
    def drift_score(self) -> float:
        """The CUSUM; above 20 the robot counts as changed."""
        return self._cusum

    @property
    def drifted(self) -> bool:
        """Whether the residuals show that the robot has changed."""
        return self._cusum > _ALARM

    def _add(self, before: ObservedTrials, after: ObservedTrials) -> None:
        self._count += 1
        own = self._settings
        groups = before.enough(own.min_trials)
        if groups:
            d = after.X.shape[1] - len(self._scales.scales)
            z, goal = after.X[-1:, :d], after.X[-1:, d:] / GOAL_SHARE
            refused: list[RefusedNear] = []
            model = OutcomeModel.near(before, self._scales, groups, z, goal, own, refused)
            seen = model.prospect(goal[:, None]).first()
            missed, variance = after.Y[-1, model.entries] - seen.raw[0], seen.variance[0]
            off, known = np.full(after.Y.shape[1], np.nan), features(seen)[0]
            off[model.entries] = missed / np.sqrt(variance)
            residual = np.nan if after.refused[-1] else _residual(missed, variance)
            self._record.append(_Expected(known, bool(after.success[-1]), off))
            self._refused += [(known, near) for near in refused]
            if self._count > self._filling and not np.isnan(residual):
                self._watch(residual)
        if self._record and self._count % _EVERY == 0:
            self._fit()

    def _fit(self) -> None:
        newest = self._record
        chances = RefusedNear.executed([near for _, near in self._refused])
        for (known, _), chance in zip(self._refused, chances, strict=True):
            known[-1] = chance
        self._refused.clear()
        seen, success = np.array([one.features for one in newest]), np.array([one.success for one in newest])
        curve = SuccessCurve.fit(seen, success, _PRIOR, _SPREAD)
        self.calibration = Calibration(curve, _spread(np.array([one.off for one in newest])))

    def _watch(self, residual: float) -> None:
        self._residuals.append(residual)
        earlier = len(self._residuals) - _NEWEST
        if earlier < _SETTLED:  # errors of a young model do not show a change of the robot
            return
        usual = max(sum(islice(self._residuals, earlier)) / earlier, _LEAST_USUAL)
        self._cusum = max(0.0, self._cusum + residual - usual - _ALLOWANCE)


@final
class DeferredCalibration:
    """A calibration that is computed when it is needed, as after a restart; for any thread.

    No thread sees a calibration by some of the trials only. Threads that call `get` at the same moment may all compute
    it, with the same result.

    Args:
        settings: The task's `exploration`.
        scales: Its units.
        filling: As `PrequentialRecord` takes it.
        count: Number of trials before the steps.
        steps: The trials, as `PrequentialRecord.extend` takes them.
    """

    def __init__(
        self, settings: Exploration, scales: OutcomeScales, filling: int, count: int, steps: Sequence[_Step]
    ) -> None:
        self._settings, self._scales, self._filling, self._count = settings, scales, filling, count
        self._steps = steps
        # The record of the first trials and their number, until a thread takes it to add more; taken by one at a time.
        self._begun = deque([(self._empty(), 0)])
        self._made: tuple[PrequentialRecord, Calibration] | None = None
        if not steps:
            self._finished()

    def get(self) -> Calibration:
        """The calibration."""
        return self._finished()[1]

    def record(self) -> PrequentialRecord:
        """The record behind it, for one caller, who may extend it; the value of `get` stays the same."""
        return self._finished()[0]

    def advance(self, trials: int) -> bool:
        """Add at most `trials` more trials, none while another thread adds some; True once all are added."""
        if self._made is None and trials:
            try:
                record, first = self._begun.pop()
            except IndexError:  # another thread has taken it
                return False
            self._add(record, first, min(first + trials, len(self._steps)))
        return self._made is not None

    def _finished(self) -> tuple[PrequentialRecord, Calibration]:
        made = self._made
        if made is None:
            record = self._empty()
            record.extend(self._steps)
            made = self._made = record, record.calibration
        return made

    def _add(self, record: PrequentialRecord, first: int, last: int) -> None:
        try:
            record.extend(self._steps[first:last])
        except BaseException:  # a trial may be added in part
            self._begun.append((self._empty(), 0))
            raise
        if last < len(self._steps):
            self._begun.append((record, last))
        else:
            self._made = record, record.calibration

    def _empty(self) -> PrequentialRecord:
        return PrequentialRecord(self._settings, self._scales, self._filling, self._count)


def _spread(off: Array) -> Array:
    """(q,) factors on standard deviations, so that nine of ten residuals (n, q) are within 1.645 of them.

    Split conformal prediction [Vovk2005] with the residuals of trials before they were learned from.
    """
    spread = np.ones(off.shape[1])
    ascending, counts = np.sort(np.abs(off), axis=0), np.count_nonzero(~np.isnan(off), axis=0)  # NaN last
    for entry, count in enumerate(counts.tolist()):
        if count >= _FEWEST:
            nine_tenths = ascending[math.ceil(0.9 * (count - 1)), entry]
            spread[entry] = min(max(nine_tenths / _NORMAL_90, _SPREADS[0]), _SPREADS[1])
    spread.setflags(write=False)
    return spread


def _residual(missed: Array, variance: Array) -> float:
    squared = np.minimum(missed * missed / (variance + _RESIDUAL_NOISE), _LARGEST)
    known = squared[~np.isnan(missed)]
    return float(known.mean()) if len(known) else float("nan")
