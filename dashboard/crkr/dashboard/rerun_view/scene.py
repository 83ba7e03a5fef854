"""The shapes of a scene for Rerun, the place of each worker's scene, and the camera."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, Final

import numpy as np
import rerun as rr

from crkr.protocol import Geom

__all__ = ["VIEW_ANGLE", "bounds", "eye", "offset", "shapes_by_body", "upright_rotation"]

COLUMNS: Final = 4
GAP: Final = 1.35  # distance of two worlds in widths
VIEW_ANGLE: Final = 0.96  # from top to bottom [rad]: what Rerun's own cameras have
HALF_HEIGHT: Final = float(np.tan(VIEW_ANGLE / 2))
WIDER: Final = 1.5  # at least: a view's width over its height
MARGIN: Final = 1.02
ASIDE: Final = np.array([0.74, -0.42, 0.54]) / np.linalg.norm([0.74, -0.42, 0.54])  # from the worlds to the eye


def shapes_by_body(geoms: Sequence[Geom]) -> Iterator[tuple[str, str, Any]]:
    """(body, kind, archetype), one for all shapes of a kind on a body."""
    groups: dict[tuple[str, str], list[Geom]] = defaultdict(list)
    for geom in geoms:
        groups[geom.body, geom.shape].append(geom)
    for (body, kind), group in groups.items():
        yield body, kind, _archetype(kind, group)


def bounds(geoms: Sequence[Geom]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Corners (3,) of a box [m] around the static shapes, floors aside; around all if nothing is static."""
    still = [geom for geom in geoms if geom.body == "world" and not _is_floor(geom)] or list(geoms)
    reach = [max(geom.size) if geom.shape != "box" else geom.size for geom in still]
    centres = np.array([geom.position for geom in still])
    extents = np.array([np.broadcast_to(size, 3) for size in reach])
    return (centres - extents).min(axis=0), (centres + extents).max(axis=0)


def _is_floor(geom: Geom) -> bool:
    return geom.shape == "box" and geom.size[2] < 0.01 * min(geom.size[:2])


def _archetype(kind: str, group: Sequence[Geom]) -> Any:
    centres = np.array([geom.position for geom in group])
    sizes = np.array([geom.size for geom in group])
    common: dict[str, Any] = {
        "quaternions": np.array([geom.quaternion for geom in group]),
        "colors": np.clip([geom.colour for geom in group], 0.0, 1.0),
        "fill_mode": rr.components.FillMode.Solid,
    }
    match kind:
        case "box":
            return rr.Boxes3D(centers=centres, half_sizes=sizes, **common)
        case "sphere":
            return rr.Ellipsoids3D(centers=centres, radii=sizes[:, 0], **common)
        case "cylinder":
            return rr.Cylinders3D(centers=centres, radii=sizes[:, 0], lengths=2 * sizes[:, 1], **common)
        case _:  # Rerun's capsule starts at its first centre, the protocol's lies around its middle
            starts = np.array([_below(geom) for geom in group])
            return rr.Capsules3D(translations=starts, radii=sizes[:, 0], lengths=2 * sizes[:, 1], **common)


def _below(geom: Geom) -> np.ndarray[Any, Any]:
    """The lower end (3,) of a capsule's axis: its centre minus half the length along its z [m]."""
    x, y, z, w = geom.quaternion
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return np.asarray(geom.position) - geom.size[1] * axis


def offset(index: int, low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Origin (3,) of the world of worker `index` [m], with worlds from `low` to `high` (3,)."""
    width = GAP * np.maximum(high - low, 0.5)
    return np.array([-(index // COLUMNS) * width[0], (index % COLUMNS) * width[1], 0.0])


def eye(
    count: int, low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Position and target (3,) [m] of a camera that sees all of `count` worlds from `low` to `high` (3,)."""
    places = np.array([offset(index, low, high) for index in range(count)])
    ends = np.array([low + places.min(axis=0), high + places.max(axis=0)])
    corners = np.array(list(product(*ends.T)))
    target = ends.mean(axis=0)
    right_down, forward = np.split((corners - target) @ upright_rotation(target + ASIDE, target), [2], axis=1)
    # A corner is in sight from a distance d if right and down are below their tangents times (d + forward).
    tangents = HALF_HEIGHT * np.array([WIDER, 1.0])
    distance = float((np.abs(right_down) / tangents - forward).max())
    return target + MARGIN * distance * ASIDE, target


def upright_rotation(position: np.ndarray[Any, Any], target: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Rotation (3, 3) of an upright camera that faces a target, which is not straight above or below it.

    The columns are the camera's right, down and forward in the frame of position and target (3,) [m].
    """
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
