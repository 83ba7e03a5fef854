"""Forward kinematics of thousands of arms at once: the chain of the scene in NumPy."""

from __future__ import annotations

from typing import Final, NamedTuple, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm

__all__ = ["Chain", "Faces"]

AXES: Final = ("z", "y", "y", "y", "z", "y")  # of the joints, as in scene.xml


class Faces(NamedTuple):
    """Paddles of b arms.

    Attributes:
        position: (b, 3) centres [m].
        normal: (b, 3) unit normals of the front faces.
        velocity: (b, 3) of the centres [m/s].
        spin: (b, 3) angular velocities [rad/s].
    """

    position: Array
    normal: Array
    velocity: Array
    spin: Array


@final
class Chain:
    """The arm's links as vectors; every link frame is parallel to the table frame when all joints are zero."""

    def __init__(self, arm: Arm) -> None:
        model = arm.model
        placements = [model.jointPlacements[index] for index in range(1, model.njoints)]
        self._links = [np.array(placement.translation) for placement in placements]
        self._tool = np.array(model.frames[model.getFrameId("paddle")].placement.translation)

    def faces(self, joints: Array, speeds: Array) -> Faces:
        """Paddle poses and velocities for joints and speeds (b, 6)."""
        count = len(joints)
        frame = np.broadcast_to(np.eye(3), (count, 3, 3))
        origin, points, axes = np.zeros((count, 3)), [], []
        for link, name, angle in zip(self._links, AXES, joints.T, strict=True):
            origin = origin + frame @ link
            points.append(origin)
            axes.append(frame[:, :, "xyz".index(name)])
            frame = _turned(frame, name, angle)
        centre = origin + frame @ self._tool
        velocity, spin = np.zeros((count, 3)), np.zeros((count, 3))
        for point, axis, speed in zip(points, axes, speeds.T, strict=True):
            turn = axis * speed[:, None]
            spin += turn
            velocity += np.cross(turn, centre - point)
        return Faces(centre, frame[:, :, 0], velocity, spin)


def _turned(frame: Array, axis: str, angle: Array) -> Array:
    """Frames (b, 3, 3) turned about their own y or z axis."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y, z = frame[:, :, 0], frame[:, :, 1], frame[:, :, 2]
    if axis == "y":
        columns = (cosine * x - sine * z, y, sine * x + cosine * z)
    else:
        columns = (cosine * x + sine * y, cosine * y - sine * x, z)
    return np.stack(columns, axis=2)
