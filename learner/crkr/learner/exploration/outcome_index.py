"""The trials that the outcome model searches: hits, misses and refused goals.

    X  (n, d + p)  trials in the metric of `OutcomeScales`      Y  (n, q)  outcomes in tolerances from the target

Rows are only appended, so a snapshot is a view that later trials do not change. At most `SEARCHED` of the newest trials
are searched in full, in less than 0.1 ms; older ones are sealed in leaves of neighbours, of which only a few are
searched (see `SealedTrials`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.exploration.sealed_trials import UNIT, SealedTrials, Single
from crkr.learner.samples.growable_array import Growable
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["LARGEST_SINGLE", "SEARCHED", "ObservedTrials", "OutcomeIndex", "in_single_precision"]

SEARCHED: Final = 12_288
_UNSEALED: Final = SEARCHED - UNIT  # least number of newest trials that are not sealed
_REPLACED: Final = 400  # trials after a change, from which on earlier ones are dropped
LARGEST_SINGLE: Final = 1e30  # squared length up to which single precision is used
_ALIGNED: Final = 4  # row lengths are multiples of this, for fast matrix products


@final
@dataclass(frozen=True, slots=True, eq=False)
class ObservedTrials:
    """The trials at one moment, oldest first; every array is read-only.

    Attributes:
        X: (n, d + p) trials in the metric.
        single: (m, *) coordinates, squared length and some zeros of the newest, which are not sealed, in single
            precision.
        fits_single: Whether all lengths are at most `LARGEST_SINGLE`.
        Y: (n, q) outcomes in tolerances from the target, NaN where not observed.
        sealed: The n - m older trials.
        counts: Number of the newest m trials in which each group was observed.
        hidden: For each group (n,) infinity where it was not observed, else 0; None if it was in all. One more group at
            the end, `everything`, is never hidden.
        refused: (n,) goals that were refused, not executed.
        any_refused: Whether any was.
        success: (n,) successes.
        shown: (n,) demonstrations.
        former: Trials from before the robot changed; None: it has not, or enough came since.
    """

    X: Array
    single: Single
    fits_single: bool
    Y: Array
    sealed: SealedTrials
    counts: tuple[int, ...]
    hidden: tuple[Single | None, ...]
    refused: NDArray[np.bool_]
    any_refused: bool
    success: NDArray[np.bool_]
    shown: NDArray[np.bool_]
    former: ObservedTrials | None = None

    @classmethod
    def of(
        cls,
        X: Array,
        single: Single,
        fits_single: bool,
        Y: Array,
        hidden: Sequence[Single],
        refused: NDArray[np.bool_],
        success: NDArray[np.bool_],
        shown: NDArray[np.bool_],
        sealed: SealedTrials | None = None,
        before: tuple[Sequence[int], int] | None = None,
        former: ObservedTrials | None = None,
    ) -> ObservedTrials:
        """Makes the value from trials and `hidden`; the arrays become read-only.

        `before`: numbers of sealed trials in which each group is hidden, and of refused ones.
        """
        sealed = SealedTrials.nothing(single.shape[1]) if sealed is None else sealed
        old_hidden, old_refused = ([0] * len(hidden), 0) if before is None else before
        arrays: list[NDArray[Any]] = [X, single, Y, *hidden, refused, success, shown]
        for array in arrays:
            array.setflags(write=False)
        first = len(X) - len(single)
        newly = [int(np.count_nonzero(own[first:])) for own in hidden]
        partly = (own if new + old else None for own, new, old in zip(hidden, newly, old_hidden, strict=True))
        any_refused = old_refused > 0 or bool(refused[first:].any())
        counts = (*(len(single) - new for new in newly), len(single))
        same = (refused, any_refused, success, shown, former)
        return cls(X, single, fits_single, Y, sealed, counts, (*partly, None), *same)

    @property
    def everything(self) -> int:
        """The group that all trials belong to."""
        return len(self.hidden) - 1

    def __len__(self) -> int:
        return len(self.X)

    def enough(self, least: int) -> tuple[int, ...]:
        """Groups observed in at least `least` of the unsealed and the former trials."""
        counts = self.counts if self.former is None else np.add(self.counts, self.former.counts)
        return tuple(group for group in range(self.everything) if counts[group] >= min(least, _UNSEALED))

    def newest(self) -> ObservedTrials:
        """The unsealed trials."""
        first = len(self) - len(self.single)
        if not first:
            return self
        hidden = [np.zeros(len(self), np.float32) if own is None else own for own in self.hidden[:-1]]
        return ObservedTrials.of(
            self.X[first:],
            self.single,
            self.fits_single,
            self.Y[first:],
            [own[first:] for own in hidden],
            self.refused[first:],
            self.success[first:],
            self.shown[first:],
        )


def in_single_precision(X: Array) -> tuple[Single, bool]:
    """Rows (n, *) of `ObservedTrials.single` for trials (n, d + p), and whether they fit."""
    n, r = X.shape
    single = np.zeros((n, -(-(r + 1) // _ALIGNED) * _ALIGNED), dtype=np.float32)
    norms = np.vecdot(X, X)
    with np.errstate(over="ignore"):
        single[:, :r], single[:, r] = X, norms
    return single, bool((norms <= LARGEST_SINGLE).all())


@final
class OutcomeIndex:
    """Follows the store's trials of kinds trial, demonstration and failed that are not removed; never evaluations.

    Args:
        scales: The task's.
        store: The trials.

    Robots change: trials from row `start` on belong to the present robot, earlier ones to the robot before.
    """

    def __init__(self, scales: OutcomeScales, store: SampleStore) -> None:
        self._scales, self._store = scales, store
        self._start, self._former_start = 0, 0
        self._former: ObservedTrials | None = None
        self._clear()

    def _clear(self) -> None:
        """Starts with new arrays, as snapshots still use the old ones."""
        d, p, q = (array.shape[1] for array in (self._store.states, self._store.goals, self._store.outcomes))
        self._X = Growable(np.float64, (d + p,))
        self._single = Growable(np.float32, in_single_precision(np.zeros((0, d + p)))[0].shape[1:])
        self._fits_single = True
        self._Y = Growable(np.float64, (q,))
        self._hidden = [Growable(np.float32) for _ in self._scales.groups]
        self._refused, self._success, self._shown = (Growable(np.bool_) for _ in range(3))
        self._rows = Growable(np.int64)
        self._sealed = [SealedTrials.nothing(self._single.rows.shape[1])]  # now, and one unit before
        self._sealed_counts: list[tuple[tuple[int, ...], int]] = [((0,) * len(self._hidden), 0)]  # after each unit
        self._snapshot: ObservedTrials | None = None

    def extend(self, rows: Indices) -> bool:
        """Add new rows of the store; True if any of them counts."""
        rows = self.usable(rows)
        if not len(rows):
            return False
        points = self._scales.points(self._store.states[rows], self._store.goals[rows])
        deviations = self._scales.deviations(self._store.outcomes[rows])
        single, fits_single = in_single_precision(points)
        self._fits_single &= fits_single
        refused = self._store.refused(rows)
        columns = [
            (self._X, points),
            (self._single, single),
            (self._Y, deviations),
            (self._refused, refused),
            (self._success, self._store.successes(rows)),
            (self._shown, self._store.demonstrated(rows)),
            (self._rows, rows),
        ]
        hidden = np.where(self._scales.observed(deviations), 0.0, np.inf)
        for column, values in (*columns, *zip(self._hidden, hidden.T, strict=True)):
            column.extend(values)
        units = _sealed_units(len(self))
        if units > self._sealed[-1].units:
            before = self._sealed[-1]
            if units > before.units + 1:
                before = self._with_sealed(before, units - 1)
            self._sealed = [before, self._with_sealed(before, units)]
        self._snapshot = None
        return True

    def holds(self, row: int) -> bool:
        """Whether a row of the store may be among the searched ones."""
        if self._former_start <= row < self._start:
            return True
        position = int(np.searchsorted(self._rows.rows, row))
        return position < len(self._rows) and bool(self._rows.rows[position] == row)

    def restart(self, kept: int) -> None:
        """Marks all but the newest trials as those before a change; `rebuild` must follow.

        Where the last change is so recent that trials before it are still in use, they stay: two changes in a row, or
        two false alarms, would otherwise leave too few.
        """
        present = self.usable(np.arange(len(self._store)))
        if len(present) >= _REPLACED:
            self._former_start = self._start
        if len(present):
            self._start = int(present[-kept:][0])

    def rebuild(self) -> None:
        """Starts again from the store."""
        self._clear()
        self._former = None
        if self._start:
            rows = np.arange(self._former_start, self._start)
            former = OutcomeIndex(self._scales, self._store)
            former.extend(rows[self._store.tried(rows)][-SEARCHED:])
            self._former = former.snapshot() if len(former) else None
        self.extend(np.arange(len(self._store)))

    def __len__(self) -> int:
        return len(self._rows)

    def snapshot(self) -> ObservedTrials:
        """A snapshot of the trials to search; later changes do not show in it."""
        if self._snapshot is None:
            self._snapshot = self.before(len(self))
        return self._snapshot

    def before(self, position: int) -> ObservedTrials:
        """The snapshot that was searched when the trial at this position came."""
        units = _sealed_units(position)
        sealed = next((one for one in self._sealed if one.units == units), None)
        if sealed is None:  # long ago
            sealed = self._with_sealed(SealedTrials.nothing(self._single.rows.shape[1]), units)
        X, Y = self._X.rows[:position], self._Y.rows[:position]
        single = self._single.rows[units * UNIT : position]
        hidden = [column.rows[:position] for column in self._hidden]
        refused, success, shown = (column.rows[:position] for column in (self._refused, self._success, self._shown))
        older = sealed, self._sealed_counts[units]
        former = self._former if position < _REPLACED else None
        return ObservedTrials.of(X, single, self._fits_single, Y, hidden, refused, success, shown, *older, former)

    def _with_sealed(self, sealed: SealedTrials, units: int) -> SealedTrials:
        """Seals more units and notes their counts."""
        for number in range(len(self._sealed_counts) - 1, units):
            unit = slice(number * UNIT, (number + 1) * UNIT)
            hidden, refused = self._sealed_counts[-1]
            newly = [int(np.count_nonzero(column.rows[unit])) for column in self._hidden]
            total = tuple(old + new for old, new in zip(hidden, newly, strict=True))
            self._sealed_counts.append((total, refused + int(np.count_nonzero(self._refused.rows[unit]))))
        return sealed.extended(self._single.rows, units, self._X.rows.shape[1])

    def usable(self, rows: Indices) -> Indices:
        """The rows among these that show what a goal leads to on the present robot."""
        rows = rows[rows >= self._start]
        return np.asarray(rows[self._store.tried(rows)])


def _sealed_units(count: int) -> int:
    """Number of units sealed after a number of trials."""
    return max(0, count - _UNSEALED) // UNIT
