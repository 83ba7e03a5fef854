"""Adaptive Non-Maximal Suppression, exact while samples come, go and change cost.

A radius depends on better samples only, so a change affects few others. Two structures compute the same radii: a pass
over all samples, and from `TREE_FROM` samples on a priority k-d tree, if its compiled code is loaded (see
`accelerate`). Density-peak clustering maintains the same quantity, the dependent distance, over changing data
[Amagata2023].
"""

from __future__ import annotations

from typing import Final, Protocol, final

import numpy as np

from crkr.learner.selection.acceleration import tree_radii
from crkr.learner.selection.anms_batch import Indices
from crkr.learner.selection.eager_radii import EagerRadii
from crkr.learner.selection.selector import Radii, Standing
from crkr.learner.selection.top_radii import Reserve
from crkr.protocol import Array

__all__ = ["TREE_FROM", "Anms", "SuppressionRadii"]

TREE_FROM: Final = 2000  # samples, from which on the tree is the quicker form


class SuppressionRadii(Protocol):
    """Radii and suppressors of numbered samples.

    Methods that change samples return the numbers of those whose radius may have changed, or None for all.
    """

    @property
    def r2(self) -> Array:
        """(n,) squared radii; -1: removed."""

    @property
    def suppressors(self) -> Indices:
        """(n,) numbers of the suppressors; -1: none."""

    def __len__(self) -> int: ...

    def samples(self) -> tuple[Array, Array]:
        """States (n, d) and costs (n,); a cost of NaN marks a removed sample."""

    def extend(self, Z: Array, costs: Array) -> Indices | None:
        """Add samples."""

    def remove(self, gone: Indices) -> Indices | None:
        """Remove samples, each named once; those they suppressed find other suppressors."""

    def recost(self, changed: Indices, costs: Array) -> Indices | None:
        """Change costs of samples, each named once."""

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Take these samples; without their radii, in about n log n. A cost of NaN marks a removed one."""


@final
class Anms:
    """Algorithm 2 of [Cardoso2017], incremental: after any sequence of calls the active set is the batch algorithm's.

    Args:
        dimensions: d.
        budget: k, the largest number of active samples.
        tree_from: Samples from which on the tree keeps the radii, if `accelerate` was called.
    """

    def __init__(self, dimensions: int, budget: int, *, tree_from: int = TREE_FROM) -> None:
        self._dimensions, self._tree_from = dimensions, tree_from
        self._radii: SuppressionRadii = EagerRadii(dimensions)
        self._reserve = Reserve(budget)

    @property
    def active(self) -> Indices:
        """Numbers of the k samples of largest radius, ascending."""
        return self._reserve.chosen

    def extend(self, Z: Array, costs: Array) -> None:
        """Add samples one by one, or all in one batch where that costs less; the result is the same."""
        self._accelerate()
        self._choose(self._radii.extend(Z, costs))

    def remove(self, indices: Indices | int) -> None:
        """Remove samples; those they suppressed find other suppressors."""
        self._accelerate()
        self._choose(self._radii.remove(np.atleast_1d(indices)))

    def recost(self, indices: Indices | int, costs: Array | float) -> None:
        """Change costs: the samples' own radii, of those they suppressed and of those they suppress now."""
        self._accelerate()
        self._choose(self._radii.recost(np.atleast_1d(indices), np.atleast_1d(costs)))

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Take these samples; without their radii, in about n log n. A cost of NaN marks a removed one."""
        form = tree_radii() if len(costs) >= self._tree_from else None
        self._radii = EagerRadii(self._dimensions) if form is None else form(self._dimensions)
        self._radii.rebuild(Z, costs, radii)
        self._reserve.reset(self._radii.r2)

    def set_budget(self, budget: int) -> None:
        """Change k and select again; radii do not depend on k."""
        self._reserve = Reserve(budget)
        self._reserve.reset(self._radii.r2)

    def standing(self, index: int) -> Standing:
        """The suppressor and the radius; None for the best sample and for a removed one."""
        suppressor = int(self._radii.suppressors[index])
        return Standing(None, None) if suppressor < 0 else Standing(suppressor, float(np.sqrt(self._radii.r2[index])))

    def radii(self) -> Radii:
        """Squared radii and suppressors without the removed samples."""
        alive = self._radii.r2 >= 0
        position = np.cumsum(alive) - 1
        suppressor = self._radii.suppressors[alive].astype(np.int64)
        return Radii(self._radii.r2[alive], np.where(suppressor < 0, -1, position[suppressor]))

    def _accelerate(self) -> None:
        """Change to the tree once it is faster and its code is loaded."""
        few = len(self._radii) < self._tree_from
        if not few and isinstance(self._radii, EagerRadii) and (tree := tree_radii()) is not None:
            (Z, costs), known, self._radii = self._radii.samples(), self.radii(), tree(self._dimensions)
            self._radii.rebuild(Z, costs, known)

    def _choose(self, touched: Indices | None) -> None:
        if touched is None:
            self._reserve.reset(self._radii.r2)
        else:
            self._reserve.update(self._radii.r2, touched)
