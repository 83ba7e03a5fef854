"""Older trials, sealed in leaves of neighbours of which a query searches only a few.

    P  (n, w)  trials in single precision, as `ObservedTrials.single`      c  (w,)  the mean of some of them

Trials are sealed in units of `UNIT`. Two parts of the same number of units are merged, as in a binary counter
[Bentley1980], up to `_LARGEST` units. The leaves depend on the trials only, so a replay searches the same ones. A part
is halved at the median of its widest side until leaves have `_LEAF` trials.

A query searches the leaves with the nearest means in the unit regions with the nearest means. This finds nearly all of
the nearest trials; in nineteen dimensions no index finds all without a look at most trials.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import takewhile
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.selection.anms_batch import Indices

__all__ = ["UNIT", "SealedTrials", "Single"]

UNIT: Final = 8192
_LEAF: Final = 128
_LEAVES: Final = UNIT // _LEAF  # in a region of one unit
_LARGEST: Final = 64  # units that are halved together
_SAMPLE: Final = 128  # trials that decide which side of a part is the widest
_REGIONS: Final = 24  # searched for each point
_LOOKED_AT: Final = 32  # leaves
_FARTHEST: Final = 1e15  # coordinates are clipped to this, so that squares stay finite

Single = NDArray[np.float32]


@final
@dataclass(frozen=True, slots=True, eq=False)
class SealedTrials:
    """The first `units` x `UNIT` trials; made by `extended`, never changed.

    Attributes:
        parts: Units in each part, the largest first.
        rows: (units, leaves, *) trials in each leaf.
        single: (units, leaves, *, w) their coordinates, squared length and some zeros.
        means: (units, leaves, w) mean coordinates of each leaf, then half their squared length.
        middles: (units, w) the same of a region.
    """

    parts: tuple[int, ...]
    rows: NDArray[np.int32]
    single: Single
    means: Single
    middles: Single

    @classmethod
    def nothing(cls, width: int) -> SealedTrials:
        """No trial is sealed; `width` is w."""
        leaves = np.empty((0, _LEAVES, _LEAF, width), dtype=np.float32)
        return cls((), np.empty(leaves.shape[:3], dtype=np.int32), leaves, leaves[:, :, 0], leaves[:, 0, 0])

    @property
    def units(self) -> int:
        """Number of sealed trials."""
        return len(self.rows)

    def extended(self, single: Single, units: int, size: int) -> SealedTrials:
        """These and the next trials, `units` units in all.

        Args:
            single: (n, w) all trials so far, at least `units` x `UNIT`.
            units: More than are sealed so far.
            size: Number of columns that are coordinates; the next one is the squared length.
        """
        whole, rest = divmod(units, _LARGEST)
        parts = (_LARGEST,) * whole + tuple(1 << bit for bit in range(_LARGEST)[::-1] if rest >> bit & 1)
        pairs = zip(self.parts, parts, strict=False)
        same = len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))
        kept = sum(parts[:same])
        made, first = [(self.rows[:kept], self.single[:kept], self.means[:kept], self.middles[:kept])], kept
        for count in parts[same:]:
            made.append(_sealed(single[first * UNIT : (first + count) * UNIT], first * UNIT, count, size))
            first += count
        arrays = [np.concatenate(column) for column in zip(*made, strict=True)]
        for array in arrays:
            array.setflags(write=False)
        return SealedTrials(parts, *arrays)

    def around(self, factors: Single, size: int) -> tuple[Indices, Single]:
        """Some thousand trials that are probably nearest to a point x: rows (c,) and coordinates (c, w).

        Args:
            factors: (w,) -2 x, then 1 and zeros.
            size: Number of coordinates among them.
        """
        towards = np.zeros_like(factors)
        towards[:size] = np.clip(0.5 * factors[:size], -_FARTHEST, _FARTHEST)
        towards[size] = 1.0  # so that products are |c - x|^2 / 2 - |x|^2 / 2
        regions = _least(self.middles @ towards, _REGIONS)
        leaves = _least((self.means[regions] @ towards).reshape(-1), _LOOKED_AT)
        where = regions[leaves // _LEAVES], leaves % _LEAVES
        return self.rows[where].reshape(-1).astype(np.int64), self.single[where].reshape(-1, self.single.shape[3])


def _sealed(points: Single, first: int, units: int, size: int) -> tuple[NDArray[np.int32], Single, Single, Single]:
    """The arrays of one part, whose trials begin at number `first`."""
    order = _halved(points[:, :size]).reshape(units, _LEAVES, _LEAF)
    leaves = points[order]
    bounded = np.clip(leaves[..., :size], -_FARTHEST, _FARTHEST)
    means = np.zeros((units, _LEAVES, points.shape[1]), dtype=np.float32)
    means[..., :size] = bounded.mean(axis=2, dtype=np.float64)
    middles = means.mean(axis=1, dtype=np.float64).astype(np.float32)
    for centres in (means, middles):
        centres[..., size] = 0.5 * np.vecdot(centres[..., :size], centres[..., :size])
    return (order + first).astype(np.int32), leaves, means, middles


def _least(values: Single, count: int) -> Indices:
    if len(values) <= count:
        return np.arange(len(values))
    return np.sort(np.argpartition(values, count)[:count])


def _halved(points: Single) -> Indices:
    """(leaves, `_LEAF`) points of each leaf. Sorts are stable, so that every processor gives the same."""
    order = np.arange(len(points))[None]
    while order.shape[1] > _LEAF:
        parts, count = order.shape
        some = np.sort(points[order[:, :: max(1, count // _SAMPLE)]], axis=1)
        middle_half = some[:, -(some.shape[1] // 4)] - some[:, some.shape[1] // 4]
        keys = points[order, middle_half.argmax(axis=1)[:, None]]
        halves = np.take_along_axis(order, keys.argsort(axis=1, kind="stable"), axis=1)
        order = halves.reshape(2 * parts, count // 2)
    return order
