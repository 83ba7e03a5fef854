"""Numbers in the order of arrival, less the removed ones."""

from __future__ import annotations

from typing import final

import numpy as np

from crkr.learner.samples.growable_array import Growable
from crkr.learner.selection.anms_batch import Indices

__all__ = ["ArrivalOrder"]


@final
class ArrivalOrder:
    """Which samples are there, oldest first."""

    def __init__(self) -> None:
        self._alive = Growable(np.bool_)
        self._first: Indices = np.empty(0, dtype=np.int64)
        self._first.setflags(write=False)

    def extend(self, count: int) -> None:
        """Numbers `count` new samples."""
        self._alive.extend(np.ones(count, dtype=np.bool_))

    def remove(self, indices: Indices | int) -> None:
        """Forgets samples."""
        self._alive.rows[indices] = False

    def first(self, count: int) -> Indices:
        """The oldest `count` that are there, read-only; the same object while they stay the same."""
        oldest = np.flatnonzero(self._alive.rows)[:count]
        if not np.array_equal(oldest, self._first):
            oldest.setflags(write=False)
            self._first = oldest
        return self._first
