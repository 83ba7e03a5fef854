"""Where each worker's world stands, so that robots learn side by side."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

__all__ = ["eye", "offset"]

COLUMNS: Final = 4
GAP: Final = 1.35  # distance of two worlds in widths


def offset(index: int, low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Where the origin (3,) of worker `index`'s world is drawn [m], with worlds from `low` to `high` (3,)."""
    width = GAP * np.maximum(high - low, 0.5)
    return np.array([-(index // COLUMNS) * width[0], (index % COLUMNS) * width[1], 0.0])


def eye(
    count: int, low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """A good place to see `count` worlds from: position and target (3,) [m]."""
    last = offset(min(count, COLUMNS) - 1, low, high)
    centre = (low + high + last) / 2
    span = float(np.linalg.norm(high - low + last))
    target = centre + np.array([0.02, -0.02, -0.02]) * span
    return target + 0.74 * span * np.array([0.74, -0.42, 0.54]), target
