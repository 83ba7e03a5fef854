"""Suppression radii in a priority k-d tree: a step takes about log n, and n in `EagerRadii`."""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.selection import priority_tree
from crkr.learner.selection.anms_batch import Indices
from crkr.learner.selection.priority_tree import BLOCK, LEVELS, SLOTS, Tree
from crkr.learner.selection.selector import Radii
from crkr.protocol import Array

__all__ = ["TreeRadii"]

_FEWEST_IN_LEAF: Final = 96  # when it is made
_SPARE: Final = 64  # leaves
_NOTED: Final = 4096  # changed radii that are named one by one
_FIRST_CAPACITY: Final = 1024  # samples
_SHARES: Final = 0.5 ** np.arange(LEVELS - 1, 0, -1)  # share of samples better than each level


@final
class TreeRadii:
    """`EagerRadii` by the compiled functions of `priority_tree`.

    Arrays have room for twice the samples; untouched pages cost no memory.

    Args:
        dimensions: d.
    """

    def __init__(self, dimensions: int) -> None:
        self._d = dimensions
        self.rebuild(np.empty((0, dimensions)), np.empty(0))

    def __len__(self) -> int:
        return self._count

    @property
    def r2(self) -> Array:
        """(n,) squared radii; -1: removed."""
        return self._tree.r2[: self._count]

    @property
    def suppressors(self) -> Indices:
        """(n,) numbers of the suppressors; -1: none."""
        return np.asarray(self._tree.samples[: self._count, 1])

    def samples(self) -> tuple[Array, Array]:
        """States (n, d) and costs (n,); a cost of NaN marks a removed sample."""
        Z, costs = np.zeros((self._count, self._d)), np.full(self._count, np.nan)
        place = self._tree.samples[: self._count, 0]
        alive = np.flatnonzero(place >= 0)
        page, slot = np.divmod(place[alive], BLOCK)
        for axis in range(self._d):
            Z[alive, axis] = self._tree.slots[page, axis, slot]
        costs[alive] = self._tree.slots[page, self._d, slot]
        return Z, costs

    def extend(self, Z: Array, costs: Array) -> Indices | None:
        """Add samples; returns the numbers of those whose radius changed, None for too many to name."""
        first, added = self._count, len(costs)
        if added > first + _FIRST_CAPACITY:
            before = self.samples()
            self.rebuild(np.concatenate([before[0], Z]), np.concatenate([before[1], costs]))
            return None
        self._reserve(first + added)
        self._count += added
        priority_tree.insert(self._tree, first, np.array(Z), np.array(costs))
        return self._touched()

    def remove(self, gone: Indices) -> Indices | None:
        """Remove samples; returns as `extend` does."""
        priority_tree.remove(self._tree, np.array(gone, dtype=np.int64))
        return self._touched()

    def recost(self, changed: Indices, costs: Array) -> Indices | None:
        """Change costs; returns as `extend` does."""
        priority_tree.recost(self._tree, np.array(changed, dtype=np.int64), np.array(costs, dtype=np.float64))
        return self._touched()

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Take these samples; without their radii, in about n log n."""
        self._build(Z, costs, radii, max(len(costs), _FIRST_CAPACITY))

    def _build(self, Z: Array, costs: Array, radii: Radii | None, room: int) -> None:
        self._count = len(costs)
        self._tree = _empty(self._d, room)
        tree, alive = self._tree, np.flatnonzero(~np.isnan(costs))
        tree.samples[: self._count], tree.r2[: self._count] = -1, -1.0
        if len(alive):
            tree.levels[1:] = np.quantile(costs[alive], _SHARES)
        squared = np.zeros(len(alive)) if radii is None else np.array(radii.squared)
        priority_tree.build(tree, 0, np.ascontiguousarray(Z[alive]), costs[alive], squared, alive)
        tree.counts[4] = len(alive)
        if radii is None:
            priority_tree.fill_radii(tree, 0, int(tree.counts[1]))
        else:
            tree.r2[alive] = squared
            priority_tree.link(tree, alive, np.where(radii.suppressor < 0, -1, alive[radii.suppressor]))

    def _touched(self) -> Indices | None:
        counts = self._tree.counts
        touched, counts[5] = int(counts[5]), 0
        return self._tree.touched[:touched].copy() if touched <= _NOTED else None

    def _reserve(self, count: int) -> None:
        """Allocates an empty tree with room for `count` samples and all nodes and leaves they may need."""
        if count > len(self._tree.r2):
            before = self._tree
            room, alive = max(count, 2 * len(before.r2)), before.r2[: self._count] >= 0
            position = np.cumsum(alive) - 1
            suppressor = self.suppressors[alive].astype(np.int64)
            radii = Radii(self.r2[alive], np.where(suppressor < 0, -1, position[suppressor]))
            self._build(*self.samples(), radii, room)


def _empty(d: int, samples: int) -> Tree:
    leaves = samples // _FEWEST_IN_LEAF + _SPARE
    pages = leaves * (SLOTS // BLOCK)
    return Tree(
        boxes=np.empty((2 * leaves, 2 * d + 3)),
        reaches=np.empty((2 * leaves, LEVELS)),
        ranges=np.empty((pages, 3)),
        levels=np.concatenate([[-np.inf], np.full(LEVELS - 1, np.inf)]),
        links=_links(2 * leaves),
        slots=np.empty((pages, d + 2, BLOCK)),
        numbers=np.empty((leaves, SLOTS + 2), dtype=np.int32),
        samples=np.empty((samples, 5), dtype=np.int32),
        r2=np.empty(samples),
        counts=np.array([1, 0, -1, -1, 0, 0], dtype=np.int64),
        touched=np.empty(_NOTED, dtype=np.int64),
    )


def _links(nodes: int) -> NDArray[np.int32]:
    links = np.empty((nodes, 5), dtype=np.int32)
    links[0] = -1
    return links
