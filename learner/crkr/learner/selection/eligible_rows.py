"""Adapts a selector to the store: rows of eligible trials instead of the selector's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from crkr.learner.kernel import Kernel
from crkr.learner.samples.growable_array import Growable
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.learner.selection.selector import Radii, Selector, SelectorFactory
from crkr.protocol import Array, TaskSpec

__all__ = ["RadiiCache", "Selection"]


@final
@dataclass(frozen=True, slots=True, eq=False)
class RadiiCache:
    """Radii that make a restart quick; may be deleted at any time.

    Attributes:
        version: Log position it belongs to.
        seqs: (n,) log positions of the eligible samples, ascending.
        squared: (n,) their squared radii, in creation length-scales.
        suppressors: (n,) positions of their suppressors in these arrays; -1 for the best.
    """

    version: int
    seqs: Indices
    squared: Array
    suppressors: Indices


@final
class Selection:
    """Which rows of the store are active.

    Args:
        spec: The task as created: distances always use its length-scales.
        store: The trials.
        factory: Makes the selector.
    """

    def __init__(self, spec: TaskSpec, store: SampleStore, factory: SelectorFactory) -> None:
        self._metric = Kernel(spec.centres, spec.lengthscales, 1.0)
        self._store = store
        self._selector: Selector = factory(len(spec.state), spec.budget)
        self._rows = Growable(np.int32)
        self._alive = Growable(np.bool_)  # those not removed since
        self._numbers: Indices | None = self._selector.active
        self.active: Indices = self._numbers.astype(np.int64)

    def extend(self, rows: Indices) -> None:
        """Adds newly eligible rows, younger than all before."""
        if len(rows):
            self._rows.extend(rows)
            self._alive.extend(np.ones(len(rows), dtype=np.bool_))
            self._selector.extend(self._standardised(rows), self._store.costs[rows])
            self._update()

    def remove(self, rows: Sequence[int]) -> None:
        """Remove rows; rows that are not eligible are ignored."""
        numbers = self._known(rows)
        if len(numbers):
            self._alive.rows[numbers] = False
            self._selector.remove(numbers)
            self._update()

    def recost(self, rows: Sequence[int]) -> None:
        """Apply the new costs of rows."""
        numbers = self._known(rows)
        if len(numbers):
            self._selector.recost(numbers, self._store.costs[self._rows.rows[numbers]])
            self._update()

    def set_budget(self, budget: int) -> None:
        """Changes the number of rows that may be active."""
        self._selector.set_budget(budget)
        self._update()

    def rebuild(self, rows: Indices, cache: RadiiCache | None = None) -> None:
        """Starts again from these rows; a matching cache saves computing the radii."""
        radii = None
        if cache is not None and np.array_equal(cache.seqs, self._store.seqs[rows]):
            radii = Radii(cache.squared, cache.suppressors)
        self._rows.replace(rows)
        self._alive.replace(np.ones(len(rows), dtype=np.bool_))
        self._selector.rebuild(self._standardised(rows), self._store.costs[rows], radii)
        self._numbers = None  # the same numbers may mean other rows now
        self._update()

    def standing(self, row: int) -> tuple[int | None, float | None]:
        """Suppressor's row and its distance in creation length-scales; None without one."""
        number = self._number(row)
        if number is None:
            return None, None
        standing = self._selector.standing(number)
        suppressor = None if standing.suppressor is None else int(self._rows.rows[standing.suppressor])
        return suppressor, standing.radius

    def cache(self, version: int) -> RadiiCache | None:
        """The radii at log position `version`, if the selector has any."""
        radii = self._selector.radii()
        if radii is None:
            return None
        rows = self._rows.rows[self._alive.rows]
        return RadiiCache(version, self._store.seqs[rows], radii.squared, radii.suppressor)

    def _standardised(self, rows: Indices) -> Array:
        return self._metric.standardise(self._store.states[rows])

    def _known(self, rows: Sequence[int]) -> Indices:
        numbers = (self._number(row) for row in rows)
        return np.array([number for number in numbers if number is not None], dtype=np.int64)

    def _number(self, row: int) -> int | None:
        rows = self._rows.rows
        number = int(np.searchsorted(rows, row))
        return number if number < len(rows) and rows[number] == row else None

    def _update(self) -> None:
        numbers = self._selector.active
        if numbers is not self._numbers:
            self._numbers = numbers
            self.active = self._rows.rows[numbers].astype(np.int64)
