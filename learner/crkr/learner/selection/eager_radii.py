"""Suppression radii updated by a pass over all samples per change, O(n d): fastest for few samples.

    Z   (n, d)  standardised states, oldest first          sup  (n,)  number of the suppressor; -1: none is better
    c   (n,)    costs; NaN: removed                        r2   (n,)  squared radii; -1: removed
    d2  (n,)    squared distances to the current sample

A radius depends on better samples only. A new sample finds its own radius, and shrinks those of worse samples that are
nearer to it than to their suppressors: one pass, O(n d), in which about one radius changes for any n. Removing or
re-costing a sample affects only those it suppresses, a pass each; where these are very many, as among equal states,
recomputing all radii costs less. Density-peak clustering maintains the same quantity, the dependent distance, over
changing data [Amagata2023].
"""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.kernel import squared_distances
from crkr.learner.samples.growable_array import Growable
from crkr.learner.selection.anms_batch import Indices, radii_kdtree
from crkr.learner.selection.selector import Radii
from crkr.protocol import Array

__all__ = ["EagerRadii"]

Mask = NDArray[np.bool_]

_BATCH: Final = 6e3  # a batch build takes as long per sample as a pass over this many


@final
class EagerRadii:
    """Radii and suppressors in plain arrays.

    Methods that change samples return the numbers of those whose radius may have changed, or None for all.

    Args:
        dimensions: d.
    """

    def __init__(self, dimensions: int) -> None:
        self._Z = Growable(np.float64, (dimensions,))
        self._c = Growable(np.float64)
        self._r2 = Growable(np.float64)
        self._sup = Growable(np.int32)
        self._d2 = np.empty(0)
        self._near = np.empty(0, dtype=np.bool_)

    def __len__(self) -> int:
        return len(self._c)

    @property
    def r2(self) -> Array:
        """(n,) squared radii; -1: removed."""
        return self._r2.rows

    @property
    def suppressors(self) -> Indices:
        """(n,) numbers of the suppressors; -1: none."""
        return self._sup.rows

    def samples(self) -> tuple[Array, Array]:
        """States (n, d) and costs (n,); a cost of NaN marks a removed sample."""
        return self._Z.rows, self._c.rows

    def extend(self, Z: Array, costs: Array) -> Indices | None:
        """Add samples one by one, or all in one batch where that costs less; the result is the same."""
        n, added = len(self._c), len(costs)
        if added * (n + added / 2) > _BATCH * (n + added):
            self.rebuild(np.concatenate([self._Z.rows, Z]), np.concatenate([self._c.rows, costs]))
            return None
        touched = [self._insert(z, float(cost)) for z, cost in zip(Z, costs, strict=True)]
        return np.concatenate(touched) if touched else np.empty(0, dtype=np.int64)

    def remove(self, gone: Indices) -> Indices | None:
        """Remove samples; those they suppressed find other suppressors, or all radii are recomputed."""
        sup = self._sup.rows
        widowed = np.flatnonzero(np.isin(sup, gone))
        self._c.rows[gone], self._r2.rows[gone], sup[gone] = np.nan, -1.0, -1
        widowed = widowed[~np.isin(widowed, gone)]
        if len(widowed) > _BATCH:
            self.rebuild(self._Z.rows.copy(), self._c.rows.copy())
            return None
        self._search(widowed)
        return np.append(widowed, gone)

    def recost(self, changed: Indices, costs: Array) -> Indices | None:
        """Change costs: the samples' own radii, of those they suppressed and of those they suppress now."""
        c, r2, sup = self._c.rows, self._r2.rows, self._sup.rows
        c[changed] = costs
        suppressed = np.flatnonzero(np.isin(sup, changed))
        freed = suppressed[~self._is_better(sup[suppressed], suppressed)]
        lost = np.union1d(freed, changed)
        if len(lost) + len(changed) > _BATCH:
            self.rebuild(self._Z.rows.copy(), c.copy())
            return None
        self._search(lost)
        touched = [lost]
        for index in changed:
            d2 = squared_distances(self._Z.rows[index : index + 1], self._Z.rows)[0]
            nearer = np.flatnonzero((d2 < r2) | ((d2 == r2) & (index < sup)))
            nearer = nearer[self._is_better(index, nearer)]
            r2[nearer], sup[nearer] = d2[nearer], index
            touched.append(nearer)
        return np.concatenate(touched)

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Take these samples; without their radii, in about n log n. A cost of NaN marks a removed one."""
        alive = np.flatnonzero(~np.isnan(costs))
        if radii is None:
            radii = Radii(*radii_kdtree(Z[alive], costs[alive]))
        r2, sup = np.full(len(costs), -1.0), np.full(len(costs), -1)
        r2[alive], sup[alive] = radii.squared, np.where(radii.suppressor < 0, -1, alive[radii.suppressor])
        for column, values in ((self._Z, Z), (self._c, costs), (self._r2, r2), (self._sup, sup)):
            column.replace(values)

    def _insert(self, z: Array, cost: float) -> Indices:
        new = len(self._c)
        r2, sup = self._r2.rows, self._sup.rows
        d2 = self._distances(z, new)
        changed = np.flatnonzero(np.less(d2, r2, out=self._near[:new]))
        radius, suppressor = self._nearest_better(d2, cost)
        changed = changed[self._c.rows[changed] > cost]  # equal costs: the older is better
        r2[changed], sup[changed] = d2[changed], new
        for column, value in ((self._Z, z), (self._c, cost), (self._r2, radius), (self._sup, suppressor)):
            column.append(value)
        return np.append(changed, new)

    def _distances(self, z: Array, count: int) -> Array:
        if len(self._d2) < count:
            self._d2, self._near = np.empty(2 * count), np.empty(2 * count, dtype=np.bool_)
        d2 = self._d2[:count]
        if count:
            squared_distances(z[None], self._Z.rows, out=d2[None])
        return d2

    def _nearest_better(self, d2: Array, cost: float) -> tuple[float, int]:
        """Squared distance to and number of the nearest older sample with a cost of at most `cost`.

        The nearest sample of all, or one up its chain of suppressors, gives a bound; only samples within it are
        compared.
        """
        c, sup = self._c.rows, self._sup.rows
        if not len(d2):
            return np.inf, -1
        nearest = found = int(d2.argmin())
        while found >= 0 and not c[found] <= cost:
            if np.isnan(c[found]):  # a removed sample has no suppressor to follow
                return _nearest(d2, c <= cost)
            found = int(sup[found])
        if found < 0:
            return np.inf, -1
        if found != nearest:
            near = np.less_equal(d2, d2[found], out=self._near[: len(d2)])
            return _nearest(d2, near & (c <= cost))
        return float(d2[found]), found

    def _search(self, indices: Indices) -> None:
        """Recomputes radius and suppressor of each sample."""
        c = self._c.rows
        for index in indices:
            better = c < c[index]
            better[:index] |= c[:index] == c[index]
            d2 = squared_distances(self._Z.rows[index : index + 1], self._Z.rows)[0]
            self._r2.rows[index], self._sup.rows[index] = _nearest(d2, better)

    def _is_better(self, these: Indices | int, others: Indices) -> Mask:
        c = self._c.rows
        better: Mask = (c[these] < c[others]) | ((c[these] == c[others]) & (these < others))
        return better


def _nearest(d2: Array, among: Mask) -> tuple[float, int]:
    candidates = np.flatnonzero(among)
    if not len(candidates):
        return np.inf, -1
    found = int(candidates[d2[candidates].argmin()])
    return float(d2[found]), found
