"""The executed trials nearest to each of several points; the other points of a batch do not change the result.

    X  (n, r)  trials in the metric       x  (b, r)  points       D  (b, k, r)  neighbours minus their point

For many trials, one matrix product in single precision gives all distances, with rounding errors that depend on the
batch. They only select candidates, whose distances are computed again. Sealed trials are searched near each point only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crkr.learner.exploration.outcome_index import LARGEST_SINGLE, ObservedTrials
from crkr.learner.kernel import squared_distances
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["Neighbours", "nearest"]

_COLUMNS: Final = 4  # columns for each neighbour; their smallest entries bound its distance
_FEW: Final = 16  # trials per neighbour, below which all distances are exact
_CROWD: Final = 8  # candidates per neighbour, above which points are searched one by one
_MARGIN: Final = 8  # times the largest error of a rounded distance; four would suffice

Rough = NDArray[np.floating[Any]]


class Neighbours(NamedTuple):
    """The k trials nearest to each of b points, nearest first.

    Attributes:
        rows: (s, b, k) rows of the trials, for each of s groups.
        D: (s, b, k, r) differences to the point.
        squared: (s, b, k) its squared length.
    """

    rows: Indices
    D: Array
    squared: Array


def nearest(trials: ObservedTrials, x: Array, groups: Sequence[int], count: int) -> Neighbours:
    """The `count` trials nearest to each point among those in which a group was observed, for each of some groups.

    Args:
        trials: What is searched.
        x: (b, r) points in the metric.
        groups: The groups, each observed in at least `count` trials.
        count: k, at least 1.
    """
    if trials.sealed.units:
        return _among_sealed(trials, x, groups, count)
    search = _among_few if len(trials) < _FEW * count else _among_many
    return search(trials, x, groups, count)


def _among_sealed(trials: ObservedTrials, x: Array, groups: Sequence[int], count: int) -> Neighbours:
    each = [_around_one(trials, point[None], groups, count) for point in x]
    return Neighbours(*(np.concatenate(parts, axis=1) for parts in zip(*each, strict=True)))


def _around_one(trials: ObservedTrials, x: Array, groups: Sequence[int], count: int) -> Neighbours:
    """The same for one point x (1, r), among the unsealed trials and those sealed ones that are probably near."""
    r, squares = x.shape[1], np.vecdot(x, x)
    factors = np.zeros(trials.single.shape[1], dtype=np.float32)
    with np.errstate(over="ignore"):
        factors[:r], factors[r] = -2.0 * x[0], 1.0
    old, theirs = trials.sealed.around(factors, r)
    first = len(trials) - len(trials.single)
    if trials.fits_single and squares.max() <= LARGEST_SINGLE:
        rough: Rough = np.concatenate([theirs @ factors, trials.single @ factors])
    else:
        near = trials.X[np.concatenate([old, np.arange(first, len(trials))])]
        rough = np.vecdot(near, near) - 2.0 * (near @ x[0])
    own = np.empty((len(groups), len(rough)), dtype=rough.dtype)
    own[:] = rough
    for place, group in enumerate(groups):
        hidden = trials.hidden[group]
        if hidden is not None:
            own[place, : len(old)] += hidden[old]
            own[place, len(old) :] += hidden[first:]
    found = []
    for near in map(np.flatnonzero, own <= _bound(own[:, None], squares, r, count)[:, 0]):
        sealed = int(near.searchsorted(len(old)))
        rows = np.concatenate([np.sort(old[near[:sealed]]), near[sealed:] + (first - len(old))])
        found.append(_measured(trials, x, np.zeros_like(rows), rows, count))
    return Neighbours(*(np.concatenate(parts)[:, None] for parts in zip(*found, strict=True)))


def _among_few(trials: ObservedTrials, x: Array, groups: Sequence[int], count: int) -> Neighbours:
    distances = squared_distances(x, trials.X)
    rows = np.empty((len(groups), len(x), count), dtype=np.int64)
    for place, group in enumerate(groups):
        hidden = trials.hidden[group]
        own = distances if hidden is None else distances + hidden
        rows[place] = own.argpartition(count - 1, axis=1)[:, :count]
    return Neighbours(rows, trials.X[rows] - x[:, None], distances[np.arange(len(x))[:, None], rows])


def _among_many(trials: ObservedTrials, x: Array, groups: Sequence[int], count: int) -> Neighbours:
    squares = np.vecdot(x, x)
    rough = _rough(trials, x, squares, groups)
    near = np.flatnonzero(rough <= _bound(rough, squares, x.shape[1], count))
    s, n = len(groups), len(trials)
    if s == len(x) == 1:
        found = _measured(trials, x, np.zeros_like(near), near, count)
    else:
        points, rows = np.divmod(near, n)  # grouped: all points of the first group, then of the next
        found = _each_measured(trials, np.concatenate([x] * s), points, rows, count)
    shape = s, -1, count
    return Neighbours(found.rows.reshape(shape), found.D.reshape(*shape, x.shape[1]), found.squared.reshape(shape))


def _rough(trials: ObservedTrials, x: Array, squares: Array, groups: Sequence[int]) -> Rough:
    """(s, b, n) squared distances minus |x|^2; infinite for a trial without the group.

    In double precision where single would overflow.
    """
    b, r = x.shape
    if trials.fits_single and squares.max() <= LARGEST_SINGLE:
        factors = np.zeros((b, trials.single.shape[1]), dtype=np.float32)
        factors[:, :r], factors[:, r] = -2.0 * x, 1.0
        rough: Rough = np.empty((len(groups), b, len(trials)), dtype=np.float32)
        np.matmul(factors, trials.single.T, out=rough[0])
    else:
        rough = np.empty((len(groups), b, len(trials)))
        np.matmul(-2.0 * x, trials.X.T, out=rough[0])
        rough[0] += np.vecdot(trials.X, trials.X)
    for place, group in reversed(list(enumerate(groups))):  # the first group last, as the others start from it
        hidden = trials.hidden[group]
        if hidden is not None:
            np.add(rough[0], hidden, out=rough[place])
        elif place:
            rough[place] = rough[0]
    return rough


def _bound(rough: Rough, squares: Array, size: int, count: int) -> Rough:
    """(s, b, 1) upper bounds of the rough distances of the `count` nearest.

    The smallest entries of `count` columns bound them, and rounding errors are proportional to
    |X|^2 + |x|^2 <= 2 |X - x|^2 + 3 |x|^2.
    """
    limits, columns = np.finfo(rough.dtype), _COLUMNS * count
    rows = rough.shape[2] // columns
    least = rough[:, :, : rows * columns].reshape(*rough.shape[:2], rows, columns).min(axis=2)
    kth = np.partition(least, count - 1, axis=2)[:, :, count - 1].astype(np.float64)
    error = (size + 8) * float(limits.eps) * (np.maximum(kth + squares, 0.0) + squares) + float(limits.tiny)
    bound = np.minimum(kth + _MARGIN * error, float(limits.max))  # finite, so that hidden trials stay out
    return np.asarray(bound[:, :, None], dtype=rough.dtype)


def _each_measured(trials: ObservedTrials, x: Array, points: Indices, rows: Indices, count: int) -> Neighbours:
    if len(rows) <= _CROWD * count * len(x):
        return _measured(trials, x, points, rows, count)
    # Points so far away that all distances round alike: one at a time.
    each = zip(x, np.split(rows, np.cumsum(np.bincount(points))[:-1]), strict=True)
    alone = [_measured(trials, one[None], np.zeros_like(its), its, count) for one, its in each]
    return Neighbours(*map(np.concatenate, zip(*alone, strict=True)))


def _measured(trials: ObservedTrials, x: Array, points: Indices, rows: Indices, count: int) -> Neighbours:
    """The nearest of these rows to their points (ascending), by exact distances.

    Ordered by distance, the older first among equals.
    """
    D = trials.X[rows]
    D -= x if len(x) == 1 else x[points]
    squared = np.vecdot(D, D)
    if len(x) == 1:
        chosen = squared.argsort(kind="stable")[None, :count]
    else:
        counts = np.bincount(points)
        first = np.cumsum(counts) - counts
        table = np.full((len(x), int(counts.max())), np.inf)
        table[points, np.arange(len(points)) - first[points]] = squared
        chosen = table.argsort(axis=1, kind="stable")[:, :count] + first[:, None]
    return Neighbours(rows[chosen], D[chosen], squared[chosen])
