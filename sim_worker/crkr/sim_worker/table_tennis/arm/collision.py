"""Collisions of the arm with the table or itself, by Coal on the shapes of the scene."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, final

import numpy as np
import pinocchio
from numpy.typing import NDArray

from crkr.sim_worker.table_tennis.arm.dynamics import Arm

__all__ = ["MARGIN", "CollisionCheck"]

Floats = NDArray[np.float64]

MARGIN: Final = 0.01  # [m]
OBSTACLES = ("table",)  # the net is out of the reach of the stretched arm, by more than 10 cm
# Upper arm and shoulder never come near the table before the forearm does.
MOVING = ("elbow", "forearm", "wrist_1", "wrist_2", "wrist_3", "handle", "paddle")
# Parts of the arm that can meet. Neighbours always touch; others never can, e.g. elbow and hand.
ITSELF: Final = {
    "pedestal": ("upper_arm", "elbow", "forearm", "wrist_1", "wrist_2", "wrist_3", "handle", "paddle"),
    "base": ("forearm", "wrist_1", "wrist_3", "handle", "paddle"),
    "shoulder": ("forearm", "wrist_1", "wrist_2", "wrist_3", "handle", "paddle"),
    "upper_arm": ("wrist_1", "wrist_2", "wrist_3", "handle", "paddle"),
    "forearm": ("wrist_3", "handle", "paddle"),
}


@final
class CollisionCheck:
    """Checks joint positions of one arm against the table, with a margin of 1 cm; the net is out of its reach.

    Args:
        arm: Its kinematics and shapes.
        itself: Also check arm and paddle against the arm and its pedestal, in every second row: links are so thick
            that between two knots of a swing they overlap by less than the margin.
    """

    def __init__(self, arm: Arm, *, itself: bool = False) -> None:
        self._model: Any = arm.model
        self._data: Any = arm.model.createData()
        self._shapes: Any = arm.shapes.copy()
        pairs = list(_pairs(itself))
        used = {name for pair in pairs for name in pair}
        for name in [shape.name for shape in self._shapes.geometryObjects if shape.name not in used]:
            self._shapes.removeGeometryObject(name)
        index = self._shapes.getGeometryId
        for moving, obstacle in pairs:
            self._shapes.addCollisionPair(pinocchio.CollisionPair(index(moving), index(obstacle)))
        self._table = self._shapes.createData()
        self._touching = self._requests()  # the arm with itself
        for pair in range(len(OBSTACLES) * len(MOVING)):
            self._touching.deactivateCollisionPair(pair)
        for pair in range(len(OBSTACLES) * len(MOVING), len(pairs)):
            self._table.deactivateCollisionPair(pair)
        self._itself = itself

    def clearance(self, positions: Floats) -> tuple[float, int]:
        """Least distance of the arm to the table [m] over rows of `positions` (n, 6) [rad], and the row of it.

        Below `MARGIN` counts as a collision.
        """
        least, where = np.inf, 0
        for row, joints in enumerate(positions):
            pinocchio.updateGeometryPlacements(self._model, self._data, self._shapes, self._table, joints)
            nearest = pinocchio.computeDistances(self._shapes, self._table)
            distance = float(self._table.distanceResults[nearest].min_distance)
            if distance < least:
                least, where = distance, row
        return least, where

    def first(self, positions: Floats) -> int | None:
        """Index of the first row of `positions` (n, 6) [rad] at which the arm meets itself, if that is checked."""
        if not self._itself:
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


def _pairs(itself: bool) -> Iterator[tuple[str, str]]:
    for obstacle in OBSTACLES:
        yield from ((moving, obstacle) for moving in MOVING)
    if itself:
        for still, others in ITSELF.items():
            yield from ((moving, still) for moving in others)
