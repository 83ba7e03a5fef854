"""What a worker publishes after each trial, so that a dashboard needs no skill code. Messages may be lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final, final

import numpy as np

from crkr.protocol.checks import entries, finite_array, required, text
from crkr.protocol.codec import Array, array_from_wire
from crkr.protocol.errors import Invalid

__all__ = ["MAX_TELEMETRY_BYTES", "SHAPES", "Geom", "Trace", "geoms_from_wire", "geoms_to_wire"]

MAX_TELEMETRY_BYTES: Final = 64 * 1024
SHAPES: Final = ("box", "sphere", "capsule", "cylinder")


@final
@dataclass(frozen=True, slots=True)
class Geom:
    """One rigid shape of the static scene, attached to a body.

    Attributes:
        body: Name of the body that carries it ("world" does not move).
        shape: "box" (half sizes x y z), "sphere" (radius), "capsule" or "cylinder" (radius, half length along z).
        size: (3,) sizes [m], unused entries zero.
        position: (3,) centre in the body's frame [m].
        quaternion: (4,) rotation body-from-geom, scalar last (x, y, z, w).
        colour: (4,) red, green, blue, alpha in [0, 1].
    """

    body: str
    shape: str
    size: tuple[float, float, float]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    colour: tuple[float, float, float, float] = (0.5, 0.5, 0.5, 1.0)


@final
@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """The motion of one trial, for displays.

    Attributes:
        time: (n,) seconds since the trial's start [s].
        bodies: Names of the b moving bodies.
        positions: (n, b, 3) body positions in the world frame [m].
        quaternions: (n, b, 4) rotations world-from-body, scalar last (x, y, z, w).
        paths: Points drawn as lines, e.g. "ball", each (n, 3) in the world frame [m].
    """

    time: Array
    bodies: tuple[str, ...]
    positions: Array
    quaternions: Array
    paths: Mapping[str, Array] = field(default_factory=dict)

    def to_wire(self) -> dict[str, Any]:
        """The trace as a message map; poses as <f4, precise to a tenth of a micrometre at arm's length."""
        return {
            "time": self.time,
            "bodies": list(self.bodies),
            "positions": self.positions.astype(np.float32),
            "quaternions": self.quaternions.astype(np.float32),
            "paths": {name: path.astype(np.float32) for name, path in self.paths.items()},
        }

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Trace:
        """Reads a trace; raises `Invalid`."""

        def array(value: object, name: str, shape: tuple[int | None, ...]) -> Array:
            return finite_array(array_from_wire(value, name), name, shape)

        bodies = tuple(text(name, "bodies", longest=64) for name in entries(message, "bodies"))
        time = array(required(message, "time"), "time", (None,))
        steps = len(time)
        return cls(
            time,
            bodies,
            array(required(message, "positions"), "positions", (steps, len(bodies), 3)),
            array(required(message, "quaternions"), "quaternions", (steps, len(bodies), 4)),
            {
                text(name, "paths", longest=64): array(path, f"paths.{name}", (steps, 3))
                for name, path in _paths(message).items()
            },
        )


def _paths(message: Mapping[str, Any]) -> Mapping[str, Any]:
    paths = message.get("paths", {})
    if not isinstance(paths, Mapping):
        raise Invalid(f"paths must be a map; got {type(paths).__name__}")
    return paths


def geoms_to_wire(geoms: Sequence[Geom]) -> list[dict[str, Any]]:
    """A scene as message maps."""
    return [asdict(geom) for geom in geoms]


def geoms_from_wire(value: object) -> tuple[Geom, ...]:
    """Reads a scene; raises `Invalid`."""
    if not isinstance(value, list):
        raise Invalid(f"a scene is a list of shapes; got {type(value).__name__}")

    def numbers(entry: Mapping[str, Any], name: str, size: int) -> Any:
        return tuple(finite_array(array_from_wire(required(entry, name), name), name, (size,)).tolist())

    return tuple(
        Geom(
            text(required(entry, "body"), "body", longest=64),
            text(required(entry, "shape"), "shape", longest=16),
            numbers(entry, "size", 3),
            numbers(entry, "position", 3),
            numbers(entry, "quaternion", 4),
            numbers(entry, "colour", 4),
        )
        for entry in value
    )
