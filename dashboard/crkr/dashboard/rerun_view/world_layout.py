"""Where each worker's world stands, so that robots learn side by side, and where they are seen from."""

from __future__ import annotations

from itertools import product
from typing import Any, Final

import numpy as np

__all__ = ["VIEW_ANGLE", "eye", "facing", "offset"]

COLUMNS: Final = 4
GAP: Final = 1.35  # distance of two worlds in widths
VIEW_ANGLE: Final = 0.96  # from top to bottom [rad]: what Rerun's own cameras have
HALF_HEIGHT: Final = float(np.tan(VIEW_ANGLE / 2))
WIDER: Final = 1.5  # at least: a view's width over its height
MARGIN: Final = 1.02
ASIDE: Final = np.array([0.74, -0.42, 0.54]) / np.linalg.norm([0.74, -0.42, 0.54])  # from the worlds to the eye


def offset(index: int, low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Where the origin (3,) of worker `index`'s world is drawn [m], with worlds from `low` to `high` (3,)."""
    width = GAP * np.maximum(high - low, 0.5)
    return np.array([-(index // COLUMNS) * width[0], (index % COLUMNS) * width[1], 0.0])


def eye(
    count: int, low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Where to see all of `count` worlds from `low` to `high` (3,) from: position and target (3,) [m]."""
    places = np.array([offset(index, low, high) for index in range(count)])
    ends = np.array([low + places.min(axis=0), high + places.max(axis=0)])
    corners = np.array(list(product(*ends.T)))
    target = ends.mean(axis=0)
    right_down, forward = np.split((corners - target) @ facing(target + ASIDE, target), [2], axis=1)
    # A corner is in sight from a distance d if right and down are below their tangents times (d + forward).
    tangents = HALF_HEIGHT * np.array([WIDER, 1.0])
    distance = float((np.abs(right_down) / tangents - forward).max())
    return target + MARGIN * distance * ASIDE, target


def facing(position: np.ndarray[Any, Any], target: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Turns (3, 3) a camera upright towards a target that is not straight above or below it.

    Its columns are what the camera calls right, down and forward, in the frame of position and target (3,) [m].
    """
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
