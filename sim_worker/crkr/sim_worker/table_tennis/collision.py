"""Whether a motion of the arm would touch the table or the net, by Coal on the shapes of the scene."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import pinocchio
from numpy.typing import NDArray

from crkr.sim_worker.table_tennis.arm import Arm

__all__ = ["CollisionCheck"]

Floats = NDArray[np.float64]

MARGIN = 0.01  # [m]
OBSTACLES = ("table", "net")
# Upper arm and shoulder never get near the table without the forearm.
MOVING = ("elbow", "forearm", "wrist_1", "wrist_2", "wrist_3", "handle", "paddle")


@final
class CollisionCheck:
    """Checks joint positions of one arm against table and net, with a margin of 1 cm."""

    def __init__(self, arm: Arm) -> None:
        self._model: Any = arm.model
        self._data: Any = arm.model.createData()
        self._shapes: Any = arm.shapes.copy()
        unused = [shape.name for shape in self._shapes.geometryObjects if shape.name not in OBSTACLES + MOVING]
        for name in unused:
            self._shapes.removeGeometryObject(name)
        index = self._shapes.getGeometryId
        for obstacle in OBSTACLES:
            for moving in MOVING:
                self._shapes.addCollisionPair(pinocchio.CollisionPair(index(moving), index(obstacle)))
        self._found: Any = self._shapes.createData()
        for request in self._found.collisionRequests:
            request.security_margin = MARGIN

    def first(self, positions: Floats) -> int | None:
        """Index of the first row of `positions` (n, 6) [rad] that collides, None if none does."""
        for row, joints in enumerate(positions):
            if pinocchio.computeCollisions(self._model, self._data, self._shapes, self._found, joints, True):
                return row
        return None
