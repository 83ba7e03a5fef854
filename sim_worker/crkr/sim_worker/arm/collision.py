"""Distances and collisions of the arm with obstacles and itself, by Coal on the shapes of the scene."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, final

import numpy as np
import pinocchio

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm

__all__ = ["MARGIN", "CollisionCheck", "own_pairs"]

Pairs = Iterable[tuple[str, str]]

MARGIN: Final = 0.01  # [m]
# Parts of the arm that can meet. Neighbours always touch; others never can, e.g. elbow and hand.
ITSELF: Final = {
    "pedestal": ("upper_arm", "elbow", "forearm", "wrist_1", "wrist_2", "wrist_3"),
    "base": ("forearm", "wrist_1", "wrist_3"),
    "shoulder": ("forearm", "wrist_1", "wrist_2", "wrist_3"),
    "upper_arm": ("wrist_1", "wrist_2", "wrist_3"),
    "forearm": ("wrist_3",),
}


def own_pairs(*tool: str) -> list[tuple[str, str]]:
    """Shapes of the arm, its pedestal and its tool that can meet each other; `tool` names the tool's shapes."""
    return [(moving, still) for still, others in ITSELF.items() for moving in (*others, *tool)]


@final
class CollisionCheck:
    """Checks joint positions of one arm, with a margin of 1 cm.

    Args:
        arm: Its kinematics and shapes.
        near: Pairs of shapes whose distance is measured, the moving one first.
        touching: Pairs checked for contact only, in every second row: links are thick enough that between two knots
            they overlap by less than the margin.
    """

    def __init__(self, arm: Arm, near: Pairs, touching: Pairs = ()) -> None:
        self._model: Any = arm.model
        self._data: Any = arm.model.createData()
        self._shapes: Any = arm.shapes.copy()
        near, touching = list(near), list(touching)
        used = {name for pair in (*near, *touching) for name in pair}
        for name in [shape.name for shape in self._shapes.geometryObjects if shape.name not in used]:
            self._shapes.removeGeometryObject(name)
        index = self._shapes.getGeometryId
        for moving, obstacle in (*near, *touching):
            self._shapes.addCollisionPair(pinocchio.CollisionPair(index(moving), index(obstacle)))
        self._near = self._shapes.createData()
        self._touching = self._requests()
        for pair in range(len(near)):
            self._touching.deactivateCollisionPair(pair)
        for pair in range(len(near), len(near) + len(touching)):
            self._near.deactivateCollisionPair(pair)
        self._touches = bool(touching)

    def clearance(self, positions: Array) -> tuple[float, int]:
        """Least distance of the pairs `near` [m] over rows of `positions` (n, 6) [rad], and its row.

        Below `MARGIN` counts as a collision.
        """
        least, where = np.inf, 0
        for row, joints in enumerate(positions):
            pinocchio.updateGeometryPlacements(self._model, self._data, self._shapes, self._near, joints)
            nearest = pinocchio.computeDistances(self._shapes, self._near)
            distance = float(self._near.distanceResults[nearest].min_distance)
            if distance < least:
                least, where = distance, row
        return least, where

    def first(self, positions: Array) -> int | None:
        """Index of the first row of `positions` (n, 6) [rad] at which a pair of `touching` meets."""
        if not self._touches:
            return None
        for row, joints in enumerate(positions):
            if row % 2 == 0 and pinocchio.computeCollisions(
                self._model, self._data, self._shapes, self._touching, joints, True
            ):
                return row
        return None

    def _requests(self) -> Any:
        data = self._shapes.createData()
        for request in data.collisionRequests:
            request.security_margin = MARGIN
        return data
