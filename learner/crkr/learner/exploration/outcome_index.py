"""The tried goals, hits, misses and refusals alike: what the outcome model looks up.

    X  (n, d + p)  trials in the metric of `OutcomeScales`      Y  (n, q)  outcomes in tolerances from the target

Rows are only appended, so that a snapshot is a view: it costs nothing, and later trials do not touch it. Only the
newest `SEARCHED` trials are kept at hand: a look through 20 000 of 19 numbers takes about 0.1 ms, and what was tried
long ago is seldom nearer than what the policy tries now. Older ones come back where newer ones are removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.samples.growable_array import Growable
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["LARGEST_SINGLE", "MARGIN", "SEARCHED", "ObservedTrials", "OutcomeIndex", "in_single_precision"]

SEARCHED: Final = 20_000
MARGIN: Final = 1_000  # older ones at hand, for what was searched when the newest came
LARGEST_SINGLE: Final = 1e30  # squared length up to which distances are compared in single precision
_ALIGNED: Final = 4  # numbers of a row, by which matrix products go through it fastest


Single = NDArray[np.float32]


@final
@dataclass(frozen=True, slots=True, eq=False)
class ObservedTrials:
    """The searched trials at one moment, oldest first; every array is read-only.

    Attributes:
        X: (n, d + p) trials in the metric.
        single: (n, *) their coordinates, squared length and some zeros, in single precision.
        fits_single: Whether all of these lengths are at most `LARGEST_SINGLE`.
        Y: (n, q) outcomes in tolerances from the target, NaN where not observed.
        counts: For each group in how many it was observed.
        hidden: For each group (n,) infinity where it was not observed, else 0; None where it was in all. After the
            groups comes one more, `everything`, which is hidden nowhere.
        refused: (n,) which goals were refused, not executed.
        any_refused: Whether any was.
        success: (n,) which did what was wanted.
        shown: (n,) which are demonstrations.
    """

    X: Array
    single: Single
    fits_single: bool
    Y: Array
    counts: tuple[int, ...]
    hidden: tuple[Single | None, ...]
    refused: NDArray[np.bool_]
    any_refused: bool
    success: NDArray[np.bool_]
    shown: NDArray[np.bool_]

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
    ) -> ObservedTrials:
        """Those of which `hidden` says where a group is hidden; the arrays become read-only."""
        arrays: list[NDArray[Any]] = [X, single, Y, *hidden, refused, success, shown]
        for array in arrays:
            array.setflags(write=False)
        counts = tuple(len(X) - int(np.count_nonzero(own)) for own in hidden)
        partly = (own if count < len(X) else None for own, count in zip(hidden, counts, strict=True))
        return cls(
            X, single, fits_single, Y, (*counts, len(X)), (*partly, None), refused, bool(refused.any()), success, shown
        )

    @property
    def everything(self) -> int:
        """The group that all trials belong to."""
        return len(self.hidden) - 1

    def __len__(self) -> int:
        return len(self.X)


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
    """Follows the store's trials, kinds trial, demonstration and failed that are not removed; never the judged ones.

    Args:
        scales: The task's.
        store: The trials.
        searched: How many of the newest are looked at.

    Attributes:
        start: First row of the store that counts.
    """

    def __init__(self, scales: OutcomeScales, store: SampleStore, searched: int = SEARCHED) -> None:
        self._scales, self._store, self._searched = scales, store, searched
        self.start = 0
        self._clear()

    def _clear(self) -> None:
        """Starts with new arrays: snapshots still look at the old ones."""
        d, p, q = (array.shape[1] for array in (self._store.states, self._store.goals, self._store.outcomes))
        self._X = Growable(np.float64, (d + p,))
        self._single = Growable(np.float32, in_single_precision(np.zeros((0, d + p)))[0].shape[1:])
        self._fits_single = True
        self._Y = Growable(np.float64, (q,))
        self._hidden = [Growable(np.float32) for _ in self._scales.groups]
        self._refused, self._success, self._shown = (Growable(np.bool_) for _ in range(3))
        self._rows = Growable(np.int64)
        self._snapshot: ObservedTrials | None = None

    def extend(self, rows: Indices) -> bool:
        """Add new rows of the store; True if any of them counts."""
        rows = self.usable(rows)
        if not len(rows):
            return False
        if len(self._rows) + len(rows) > 2 * (self._searched + MARGIN):
            rows = np.concatenate([self._rows.rows, rows])[-(self._searched + MARGIN) :]
            self._clear()
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
        self._snapshot = None
        return True

    def holds(self, row: int) -> bool:
        """Whether a row of the store is among those at hand."""
        position = int(np.searchsorted(self._rows.rows, row))
        return position < len(self._rows) and bool(self._rows.rows[position] == row)

    def rebuild(self, rows: Indices) -> None:
        """Starts again with some rows of the store."""
        self._clear()
        self.extend(rows[-(self._searched + MARGIN) :])

    def __len__(self) -> int:
        return len(self._rows)

    def snapshot(self) -> ObservedTrials:
        """What is searched from now on; later changes do not show in it."""
        if self._snapshot is None:
            self._snapshot = self.before(len(self))
        return self._snapshot

    def before(self, position: int) -> ObservedTrials:
        """What was searched when the trial at this position came, of those at hand."""
        part = slice(max(0, position - self._searched), position)
        X, single, Y = (column.rows[part] for column in (self._X, self._single, self._Y))
        hidden = [column.rows[part] for column in self._hidden]
        flags = (column.rows[part] for column in (self._refused, self._success, self._shown))
        return ObservedTrials.of(X, single, self._fits_single, Y, hidden, *flags)

    def usable(self, rows: Indices) -> Indices:
        """Those of some rows that tell what a goal leads to, from the row `start` on."""
        rows = rows[rows >= self.start]
        return np.asarray(rows[self._store.tried(rows)])
