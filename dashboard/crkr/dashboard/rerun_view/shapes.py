"""A scene's shapes as Rerun draws them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr

from crkr.protocol import Geom

__all__ = ["bounds", "shapes_by_body"]


def shapes_by_body(geoms: Sequence[Geom]) -> Iterator[tuple[str, str, Any]]:
    """One archetype for all shapes of a kind on a body: (body, kind, archetype)."""
    groups: dict[tuple[str, str], list[Geom]] = defaultdict(list)
    for geom in geoms:
        groups[geom.body, geom.shape].append(geom)
    for (body, kind), group in groups.items():
        yield body, kind, _archetype(kind, group)


def bounds(geoms: Sequence[Geom]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Corners (3,) of a box [m] around the shapes that do not move, floors aside; around all if there are none."""
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
