"""The executed trials whose outcome was observed, hits and misses alike: what the outcome model looks up.

    X  (n, d + p)  trials in the metric of `OutcomeScales`      Y  (n, q)  outcomes in tolerances from the target

Rows are only appended, so that a snapshot is a view: it costs nothing, and later trials do not touch it. Only the
newest `SEARCHED` trials are kept at hand: a look through 20 000 of 19 numbers takes about half a millisecond, and what
was tried long ago is seldom nearer than what the policy tries now. Older ones come back where newer ones are removed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.anms_batch import Indices
from crkr.learner.growable import Growable
from crkr.learner.outcome_scales import OutcomeScales
from crkr.learner.store import SampleStore
from crkr.protocol import Array

__all__ = ["SEARCHED", "ObservedTrials", "OutcomeIndex"]

SEARCHED: Final = 20_000


@final
@dataclass(frozen=True, slots=True, eq=False)
class ObservedTrials:
    """The searched trials at one moment, oldest first; every array is read-only.

    Attributes:
        X: (n, d + p) trials in the metric.
        norms: (n,) squared lengths of their rows.
        Y: (n, q) outcomes in tolerances from the target, NaN where not observed.
        members: For each group the rows in which it was observed; None where it was in all.
    """

    X: Array
    norms: Array
    Y: Array
    members: tuple[Indices | None, ...]

    def __len__(self) -> int:
        return len(self.norms)

    def count(self, group: int) -> int:
        """In how many a group was observed."""
        members = self.members[group]
        return len(self) if members is None else len(members)


@final
class OutcomeIndex:
    """Follows the store's trials, kinds trial, demonstration and failed that are not removed; never the judged ones.

    Args:
        scales: The task's.
        store: The trials.
        searched: How many of the newest are looked at.
    """

    def __init__(self, scales: OutcomeScales, store: SampleStore, searched: int = SEARCHED) -> None:
        self._scales, self._store, self._searched = scales, store, searched
        self._clear()

    def _clear(self) -> None:
        """Starts with new arrays: snapshots still look at the old ones."""
        d, p, q = (array.shape[1] for array in (self._store.states, self._store.goals, self._store.outcomes))
        self._X = Growable(np.float64, (d + p,))
        self._norms = Growable(np.float64)
        self._Y = Growable(np.float64, (q,))
        self._seen = Growable(np.bool_, (len(self._scales.groups),))
        self._rows = Growable(np.int64)
        self._snapshot: ObservedTrials | None = None

    def extend(self, rows: Indices) -> bool:
        """Takes note of new rows of the store; whether any of them counts."""
        rows = self._usable(rows)
        if not len(rows):
            return False
        if len(self._rows) + len(rows) > 2 * self._searched:
            rows = np.concatenate([self._rows.rows, rows])[-self._searched :]
            self._clear()
        points = self._scales.points(self._store.states[rows], self._store.goals[rows])
        deviations = self._scales.deviations(self._store.outcomes[rows])
        for column, values in (
            (self._X, points),
            (self._norms, np.vecdot(points, points)),
            (self._Y, deviations),
            (self._seen, self._scales.observed(deviations)),
            (self._rows, rows),
        ):
            column.extend(values)
        self._snapshot = None
        return True

    def holds(self, row: int) -> bool:
        """Whether a row of the store is among those at hand."""
        position = int(np.searchsorted(self._rows.rows, row))
        return position < len(self._rows) and bool(self._rows.rows[position] == row)

    def rebuild(self) -> None:
        """Starts again from the store."""
        usable = self._usable(np.arange(len(self._store)))
        self._clear()
        self.extend(usable[-self._searched :])

    def snapshot(self) -> ObservedTrials:
        """What is searched from now on; later changes do not show in it."""
        if self._snapshot is None:
            newest = slice(max(0, len(self._rows) - self._searched), None)
            X, norms, Y = (column.rows[newest] for column in (self._X, self._norms, self._Y))
            for array in (X, norms, Y):
                array.setflags(write=False)
            self._snapshot = ObservedTrials(X, norms, Y, tuple(map(_members, self._seen.rows[newest].T)))
        return self._snapshot

    def _usable(self, rows: Indices) -> Indices:
        executed = rows[self._store.executed(rows)]
        seen = self._scales.observed(self._store.outcomes[executed])
        return np.asarray(executed[seen.any(axis=1)])


def _members(seen: NDArray[np.bool_]) -> Indices | None:
    if seen.all():
        return None
    members = np.flatnonzero(seen)
    members.setflags(write=False)
    return members
