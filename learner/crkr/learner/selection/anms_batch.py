"""Adaptive Non-Maximal Suppression of a whole set at once [Cardoso2017, alg. 2].

    Z  (n, d)  standardised states, oldest first      r2  (n,)  squared suppression radii
    c  (n,)    costs                                  suppressor  (n,)  sample that sets the radius; -1 for the best

A sample's radius is its distance to the nearest better sample, infinite for the best. Better means a lower cost, or the
same cost and older. The k samples of largest radius are active, older ones first among equals.
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

_BRUTE_FORCE: Final = 128  # samples
_LEAF: Final = 24  # samples in a leaf of a tree
_CROWD: Final = 16  # neighbours per sample in one query
_SAFETY: Final = 1.0 + 1e-9  # slack, as the tree rounds distances differently


def _order(c: Array) -> Indices:
    return np.lexsort((np.arange(len(c)), c))


def radii(Z: Array, c: Array) -> tuple[Array, Indices]:
    """Squared radii and suppressors by definition, O(n^2 d); the reference in tests."""
    order = _order(c)
    r2, suppressor = np.full(len(c), np.inf), np.full(len(c), -1, dtype=np.int64)
    for rank, index in enumerate(order[1:], start=1):
        better = np.sort(order[:rank])
        d2 = squared_distances(Z[index : index + 1], Z[better])[0]
        nearest = int(d2.argmin())  # the oldest among equally near ones
        r2[index], suppressor[index] = d2[nearest], better[nearest]
    return r2, suppressor


def radii_kdtree(Z: Array, c: Array) -> tuple[Array, Indices]:
    """Squared radii and suppressors with k-d trees, O(n log^2 n) for any costs, also where many states coincide.

    In cost order, the worse half searches a tree of the better half for its nearest neighbours; then each half does the
    same. Results equal those of `radii` bit by bit, except for suppressors of samples that share a state.
    """
    order = _order(c)
    X, r2, suppressor = Z[order], np.full(len(c), np.inf), np.full(len(c), -1, dtype=np.int64)
    blocks = [(0, len(c))]
    while blocks:
        start, stop = blocks.pop()
        if stop - start <= _BRUTE_FORCE:
            better, worse, d2 = _inside(X[start:stop])
            better, worse = better + start, worse + start
        else:
            middle = (start + stop) // 2
            blocks += [(start, middle), (middle, stop)]
            better, worse, d2 = _across(X[start:middle], X[middle:stop], order[start:middle])
            better, worse = better + start, worse + middle
        _keep_nearest(r2, suppressor, order[worse], order[better], d2)
    return r2, suppressor


def _inside(X: Array) -> tuple[Indices, Indices, Array]:
    """Pairs (better, worse) of a small block in cost order that may set a radius, with squared distances."""
    d2 = squared_distances(X, X)
    d2[np.triu_indices(len(X))] = np.inf
    worse, better = np.nonzero((d2 == d2.min(axis=1, keepdims=True, initial=np.inf)) & np.isfinite(d2))
    return better, worse, d2[worse, better]


def _across(better: Array, worse: Array, age: Indices) -> tuple[Indices, Indices, Array]:
    """The same between two blocks: nearest neighbours, several where the tree's rounding leaves a choice.

    Where these would be very many, as among a few repeated states, each state is searched once: the oldest of equal
    better samples, by `age`, may set a radius, and equal worse samples share it.
    """
    tree, along = KDTree(better, _LEAF), KDTree(worse, _LEAF).indices  # one at a time: a third of the time
    distance, neighbour = tree.query(worse[along], k=2)
    pairs = [(neighbour[:, 0], along)]
    unsure = (distance[:, 1] <= distance[:, 0] * _SAFETY) & (distance[:, 0] > 0)
    if unsure.any():
        around, reach = worse[along[unsure]], distance[unsure, 0] * _SAFETY
        if tree.query_ball_point(around, reach, return_length=True).sum() > _CROWD * len(worse):
            return _among_equals(better, worse, age)
        balls = tree.query_ball_point(around, reach)
        pairs.append((np.concatenate(balls).astype(np.int64), np.repeat(along[unsure], [len(ball) for ball in balls])))
    left, right = (np.concatenate(side) for side in zip(*pairs, strict=True))
    d2 = np.zeros(len(left))
    for dimension in range(better.shape[1]):  # in this order the sum has the bits of `squared_distances`
        d2 += (better[left, dimension] - worse[right, dimension]) ** 2
    return left, right, d2


def _among_equals(better: Array, worse: Array, age: Indices) -> tuple[Indices, Indices, Array]:
    """One pair for each worse sample, searched among distinct states only."""
    oldest = age.argsort()
    states, first = np.unique(better[oldest], axis=0, return_index=True)  # the first among equals is the oldest
    oldest = oldest[first]
    states, oldest = states[np.argsort(age[oldest])], oldest[np.argsort(age[oldest])]
    asked, members = np.unique(worse, axis=0, return_inverse=True)
    tree = KDTree(states, _LEAF)
    nearest, d2 = np.empty(len(asked), dtype=np.int64), np.empty(len(asked))
    reach = tree.query(asked)[0] * _SAFETY
    for index, ball in enumerate(map(tree.query_ball_point, asked, reach)):
        near = np.sort(np.array(ball, dtype=np.int64))
        distances = squared_distances(asked[index : index + 1], states[near])[0]
        nearest[index], d2[index] = near[distances.argmin()], distances.min()
    members = members.reshape(-1)
    return oldest[nearest[members]], np.arange(len(worse)), d2[members]


def _keep_nearest(r2: Array, suppressor: Indices, of: Indices, candidate: Indices, d2: Array) -> None:
    """Accepts candidates that are nearer than the suppressors so far, or as near and older."""
    best = np.lexsort((candidate, d2, of))
    best = best[np.diff(of[best], prepend=-1) != 0]
    of, candidate, d2 = of[best], candidate[best], d2[best]
    nearer = (d2 < r2[of]) | ((d2 == r2[of]) & (candidate < suppressor[of]))
    r2[of[nearer]], suppressor[of[nearer]] = d2[nearer], candidate[nearer]


def top(r2: Array, k: int) -> Indices:
    """Indices of the k largest radii, ascending, by partition, O(n); older ones first among equals."""
    if k >= len(r2):
        return np.arange(len(r2))
    threshold = np.partition(r2, len(r2) - k)[len(r2) - k]
    chosen = np.flatnonzero(r2 > threshold)
    ties = np.flatnonzero(r2 == threshold)[: k - len(chosen)]
    return np.sort(np.concatenate([chosen, ties]))
