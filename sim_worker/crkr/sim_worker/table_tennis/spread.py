"""Choosing a few points that cover many."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

__all__ = ["spread_out"]

Floats = NDArray[np.float64]


def spread_out(points: Floats, radius: float) -> Iterator[int]:
    """Indices of `points` (n, d) so that each next one is farthest from those before: greedy k-centre [Gonzalez1985].

    Starts next to the origin; points farther than `radius` from it come last, nearest first.
    """
    norms = np.linalg.norm(points, axis=1)
    inside = np.flatnonzero(norms <= radius)
    distances = np.full(len(inside), np.inf)
    if inside.size:
        chosen = int(np.argmin(norms[inside]))
        for _ in range(len(inside)):
            yield int(inside[chosen])
            distances = np.minimum(distances, np.linalg.norm(points[inside] - points[inside[chosen]], axis=1))
            chosen = int(np.argmax(distances))
    outside = np.flatnonzero(norms > radius)
    yield from (int(i) for i in outside[np.argsort(norms[outside], kind="stable")])
