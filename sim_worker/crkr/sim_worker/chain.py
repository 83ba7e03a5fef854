"""A chain of links, for users' skills: its shapes, positions and motion, as displays draw them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, final

import numpy as np

from crkr.protocol import Array, Geom, Trace

__all__ = ["Chain"]

_TARGET: Final = "target"
_COLOURS: Final = ((0.36, 0.55, 0.78, 1.0), (0.62, 0.73, 0.85, 1.0))
_RED: Final = (0.85, 0.33, 0.24, 0.8)
_LYING: Final = (0.0, 0.5**0.5, 0.0, 0.5**0.5)  # turns a capsule's z to the body's x


@final
class Chain:
    """An arm of straight links, each a capsule from one point to the next.

    Args:
        links: Name -> length [m], from the base on.
        target: Radius of a ball that shows the target [m]; 0: no ball.
        radius: Of the links [m].
    """

    def __init__(self, links: Mapping[str, float], *, target: float = 0.0, radius: float = 0.03) -> None:
        self.links: Final = dict(links)
        self._target, self._radius = target, radius

    def points(self, angles: object) -> Array:
        """Ends of the links of a planar arm, each angle relative to the link before.

        Args:
            angles: (n, k) or (k,) angles of the k joints [rad].

        Returns:
            (n, k + 1, 3) or (k + 1, 3) the base at the origin, then each link's end, in the world's x-y plane [m].
        """
        turned = np.cumsum(np.asarray(angles, dtype=np.float64), axis=-1)
        steps = np.stack([np.cos(turned), np.sin(turned), 0 * turned], axis=-1)
        steps *= np.array(list(self.links.values()))[:, None]
        base = np.zeros((*turned.shape[:-1], 1, 3))
        return np.concatenate([base, np.cumsum(steps, axis=-2)], axis=-2)

    def scene(self) -> list[Geom]:
        """The shapes, for a skill's `scene`."""
        shapes = [
            Geom(name, "capsule", (self._radius, length / 2, 0.0), (length / 2, 0.0, 0.0), _LYING, _COLOURS[place % 2])
            for place, (name, length) in enumerate(self.links.items())
        ]
        if self._target:
            shapes.append(Geom(_TARGET, "sphere", (self._target, 0.0, 0.0), colour=_RED))
        return shapes

    def trace(self, time: object, points: object, target: object = None) -> Trace:
        """A motion, for `TrialResult.trace`; the last point's path is drawn as "end".

        Args:
            time: (n,) seconds since the trial's start [s].
            points: (n, k + 1, 3) base and ends of the k links in the world [m], as `points` gives them.
            target: (2,) or (3,) position of the ball in this trial [m].
        """
        ends = np.asarray(points, dtype=np.float64)
        starts, turns = ends[:, :-1], _from_x(np.diff(ends, axis=1))
        names = tuple(self.links)
        if self._target and target is not None:
            at = np.zeros(3)
            given = np.asarray(target, dtype=np.float64)
            at[: len(given)] = given
            names = (*names, _TARGET)
            starts = np.concatenate([starts, np.broadcast_to(at, (len(ends), 1, 3))], axis=1)
            turns = np.concatenate([turns, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(ends), 1, 4))], axis=1)
        return Trace(np.asarray(time, dtype=np.float64), names, starts, turns, {"end": ends[:, -1]})


def _from_x(vectors: Array) -> Array:
    """Quaternions (..., 4), scalar last, that turn the x axis to vectors (..., 3) the shortest way."""
    unit = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    x, y, z = np.moveaxis(unit, -1, 0)
    turned = np.stack([0 * x, -z, y, 1 + x], axis=-1)  # half way between x and the vector
    back = x < -1 + 1e-9  # the opposite: half a turn about z
    turned[back] = (0.0, 0.0, 1.0, 0.0)
    return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True))
