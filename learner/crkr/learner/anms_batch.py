"""Adaptive Non-Maximal Suppression of a whole set at once [Cardoso2017, alg. 2].

    Z  (n, d)  standardised states, oldest first      r2  (n,)  squared suppression radii
    c  (n,)    costs                                  suppressor  (n,)  who sets the radius; -1 for the best

A sample's radius is its distance to the nearest better one; the best has none better, so its radius is infinite. Better
means a lower cost, or the same cost and older. The k samples of largest radius are active; of equal radii the older is.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from crkr.learner.kernel import squared_distances
from crkr.protocol import Array

__all__ = ["Indices", "radii", "radii_kdtree", "top"]

Indices = NDArray[np.int64]

_FIRST_NEIGHBOURS: Final = 8
_QUERIES_AT_ONCE: Final = 2_000_000  # neighbours held at a time
_SAFETY: Final = 1.0 + 1e-9  # the tree rounds distances in its own way


def _order(c: Array) -> Indices:
    return np.lexsort((np.arange(len(c)), c))


def radii(Z: Array, c: Array) -> tuple[Array, Indices]:
    """Squared radii and suppressors in the obvious way, O(n^2 d): the truth the others are tested against."""
    order = _order(c)
    r2, suppressor = np.full(len(c), np.inf), np.full(len(c), -1, dtype=np.int64)
    for rank, index in enumerate(order[1:], start=1):
        better = np.sort(order[:rank])
        d2 = squared_distances(Z[index : index + 1], Z[better])[0]
        nearest = int(d2.argmin())  # the oldest of equally near ones
        r2[index], suppressor[index] = d2[nearest], better[nearest]
    return r2, suppressor


def radii_kdtree(Z: Array, c: Array) -> tuple[Array, Indices]:
    """Squared radii and suppressors, O(n log n) on usual data: asks a k-d tree for ever more neighbours.

    Radii have the same bits as those of `radii`. So do suppressors, unless more samples than were asked for share one
    state.
    """
    order = _order(c)
    rank = np.empty(len(c), dtype=np.int64)
    rank[order] = np.arange(len(c))
    r2, suppressor = np.full(len(c), np.inf), np.full(len(c), -1, dtype=np.int64)
    tree, pending, count = KDTree(Z), order[1:], _FIRST_NEIGHBOURS
    while len(pending):
        count = min(count, len(c))
        block = max(1, _QUERIES_AT_ONCE // count)
        found = [
            _settle(tree, Z, rank, pending[start : start + block], count, r2, suppressor)
            for start in range(0, len(pending), block)
        ]
        pending, count = pending[~np.concatenate(found)], 4 * count
    return r2, suppressor


def _settle(
    tree: KDTree, Z: Array, rank: Indices, pending: Indices, count: int, r2: Array, suppressor: Indices
) -> NDArray[np.bool_]:
    """Writes the radii that the nearest `count` neighbours decide; returns which of `pending` they were."""
    distance, neighbour = tree.query(Z[pending], k=np.arange(1, count + 1))  # (a, count) both
    better = rank[neighbour] < rank[pending][:, None]
    first = better.argmax(axis=1)[:, None]
    nearest = np.take_along_axis(distance, first, axis=1)
    reached = (distance[:, -1:] > nearest * _SAFETY) | (nearest == 0.0) | (count == len(Z))
    settled = np.take_along_axis(better, first, axis=1)[:, 0] & reached[:, 0]
    rows, columns = np.nonzero(better & (distance <= nearest * _SAFETY) & settled[:, None])
    queries, candidates = pending[rows], neighbour[rows, columns]
    d2 = np.zeros(len(rows))
    for dimension in range(Z.shape[1]):  # in this order the sum has the bits of `squared_distances`
        d2 += (Z[queries, dimension] - Z[candidates, dimension]) ** 2
    best = np.lexsort((candidates, d2, rows))
    _, heads = np.unique(rows[best], return_index=True)
    chosen = best[heads]
    r2[queries[chosen]], suppressor[queries[chosen]] = d2[chosen], candidates[chosen]
    return np.asarray(settled)


def top(r2: Array, k: int) -> Indices:
    """Indices of the k largest radii, ascending, by partition, O(n); of equal radii the older."""
    if k >= len(r2):
        return np.arange(len(r2))
    threshold = np.partition(r2, len(r2) - k)[len(r2) - k]
    chosen = np.flatnonzero(r2 > threshold)
    ties = np.flatnonzero(r2 == threshold)[: k - len(chosen)]
    return np.sort(np.concatenate([chosen, ties]))
