"""The k largest of many radii that mostly shrink, without a pass over all of them at each change.

    r2  (n,)  squared radii; -1: removed        k  budget        tau  smallest radius chosen

A pool of about 2k samples holds every radius of at least `_floor`. Choosing k of it is exact while it has k; a new
pool, O(n), is drawn only when it has too few or too many.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np

from crkr.learner.selection.anms_batch import Indices, top
from crkr.protocol import Array

__all__ = ["Reserve"]

_RESERVE: Final = 2  # budgets that a new pool holds
_TOO_MANY: Final = 4  # times its first size, at which a new pool is drawn


@final
class Reserve:
    """Maintains the k samples of largest radius; older ones first among equals.

    Args:
        budget: k.
    """

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._members: Indices = np.empty(0, dtype=np.int64)
        self._floor = 0.0
        self._limit = 0
        self._tau = -np.inf
        self._numbers: set[int] = set()  # ranks of `chosen`
        self.chosen: Indices = _frozen(self._members)

    def reset(self, r2: Array) -> None:
        """Draws a new pool and chooses from it."""
        self._draw(r2)
        self._choose(r2)

    def update(self, r2: Array, touched: Indices) -> None:
        """Apply changed radii of these samples, and choose again if needed."""
        joining = touched[r2[touched] >= self._floor]
        if len(joining):
            self._members = np.concatenate([self._members, joining])
        if (r2[touched] >= self._tau).any() or not self._numbers.isdisjoint(touched.tolist()):
            if len(self._members) > self._limit:
                self._draw(r2)
            self._choose(r2)

    def _draw(self, r2: Array) -> None:
        size = min(_RESERVE * self._budget, int(np.count_nonzero(r2 >= 0)))
        self._floor = float(np.partition(r2, len(r2) - size)[len(r2) - size]) if 0 < size < len(r2) else 0.0
        self._members = np.flatnonzero(r2 >= self._floor)
        self._limit = _TOO_MANY * max(len(self._members), self._budget)

    def _choose(self, r2: Array) -> None:
        members = np.sort(self._members[r2[self._members] >= self._floor])
        self._members = members[np.diff(members, prepend=-1) > 0]  # each once: some may have joined again
        if len(self._members) < self._budget and self._floor > 0:
            self._draw(r2)
        radii = r2[self._members]
        chosen = self._members[top(radii, self._budget)]
        self._tau = float(r2[chosen].min()) if len(chosen) == self._budget else -np.inf
        if not np.array_equal(chosen, self.chosen):
            self.chosen, self._numbers = _frozen(chosen), set(chosen.tolist())


def _frozen(indices: Indices) -> Indices:
    indices.setflags(write=False)
    return indices
