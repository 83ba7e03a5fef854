"""Selection by order of arrival alone, for comparison with the filter."""

from __future__ import annotations

from typing import final

import numpy as np

from crkr.learner.samples.growable_array import Growable
from crkr.learner.selection.anms_batch import Indices
from crkr.learner.selection.selector import Radii, Standing
from crkr.protocol import MOST_KEPT, Array

__all__ = ["FirstCome"]


@final
class FirstCome:
    """The first `budget` samples are active; later ones only replace removed ones. Make it by name.

    `freeze` stops learning when the budget is full. `full` keeps everything, as Cost-regularized Kernel Regression
    without a filter does: a step and a prediction cost O(n^2), so it stops at `MOST_KEPT` samples, whatever the budget.
    """

    def __init__(self, budget: int, bounded: bool = True) -> None:
        self._budget, self._bounded = budget, bounded
        self._kept = Growable(np.bool_)  # whether each sample is not removed
        self._active: Indices = np.empty(0, dtype=np.int64)
        self._active.setflags(write=False)

    @classmethod
    def freeze(cls, dimensions: int, budget: int) -> FirstCome:
        """Keeps the oldest `budget` samples; `dimensions` is not used."""
        del dimensions  # Unused; the interface's.
        return cls(budget)

    @classmethod
    def full(cls, dimensions: int, budget: int) -> FirstCome:
        """Keeps all samples, up to `MOST_KEPT`."""
        del dimensions, budget  # Unused; the interface's.
        return cls(MOST_KEPT, bounded=False)

    @property
    def active(self) -> Indices:
        """Numbers of the oldest samples that are not removed, read-only; the same object while they stay the same."""
        oldest = np.flatnonzero(self._kept.rows)[: self._budget]
        if not np.array_equal(oldest, self._active):
            oldest.setflags(write=False)
            self._active = oldest
        return self._active

    def extend(self, Z: Array, costs: Array) -> None:
        """Adds samples; they are active while there is room."""
        del Z  # Unused.
        self._kept.extend(np.ones(len(costs), dtype=np.bool_))

    def remove(self, indices: Indices | int) -> None:
        """Removes samples; the next oldest replace them."""
        self._kept.rows[indices] = False

    def recost(self, indices: Indices | int, costs: Array | float) -> None:
        """Changes nothing: costs are not used."""

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Takes these samples."""
        del radii  # Unused.
        self._kept = Growable(np.bool_)
        self.extend(Z, costs)

    def set_budget(self, budget: int) -> None:
        """Adds or drops the youngest active samples, if there is a budget."""
        if self._bounded:
            self._budget = budget

    def standing(self, index: int) -> Standing:
        """None: order of arrival alone decides."""
        del index  # Unused.
        return Standing(None, None)

    def radii(self) -> None:
        """None: there are no radii."""
