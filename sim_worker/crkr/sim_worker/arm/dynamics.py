"""Kinematics, dynamics and control of the arm, by Pinocchio on the same scene that MuJoCo simulates."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, final

import numpy as np
import pinocchio

from crkr.protocol import Array
from crkr.sim_worker.primitives.joint_motion import JointTrajectory

__all__ = ["ACCELERATION_LIMITS", "SPEED_LIMITS", "Arm", "Gains", "ToolPose", "Unreachable", "tracking_controls"]

# Universal Robots UR10e data sheet: 120 degrees/s for base and shoulder, 180 for the rest.
SPEED_LIMITS = np.deg2rad([120.0, 120.0, 180.0, 180.0, 180.0, 180.0])
# Our assumption, well inside what the torque limits allow in this workspace [rad/s^2].
ACCELERATION_LIMITS = np.array([20.0, 20.0, 25.0, 40.0, 40.0, 60.0])

DAMPING = 1e-4  # of the inverse kinematics' least squares, in [m^2]
POSTURE_GAIN = 0.5  # pull towards the preferred posture in the redundant direction, per iteration
PULLS = 25  # iterations with that pull; the rest only close the error
ITERATIONS = 40


class Unreachable(Exception):
    """No joint position puts the tool there within the limits."""


class ToolPose(NamedTuple):
    """Where the tool is and how it moves: a paddle's face, a hand's palm.

    Attributes:
        position: (3,) its centre [m].
        normal: (3,) unit normal of its front.
        velocity: (3,) of the centre [m/s].
        spin: (3,) angular velocity [rad/s].
    """

    position: Array
    normal: Array
    velocity: Array
    spin: Array


@final
class Arm:
    """Six joints and a tool; joint vectors are (6,) in radians from shoulder pan to wrist 3.

    Args:
        scene: Text of a scene that holds the arm.
        tool: Name of the site on the tool whose x axis is the tool's normal.
    """

    def __init__(self, scene: str, tool: str) -> None:
        with TemporaryDirectory() as folder:  # Pinocchio reads files only
            path = Path(folder) / "scene.xml"
            path.write_text(scene, encoding="utf-8")
            self.model: Any = pinocchio.buildModelFromMJCF(str(path))
            # Shapes without collision masks, obstacles included, are "visual" to Pinocchio.
            self.shapes: Any = pinocchio.buildGeomFromMJCF(self.model, str(path), pinocchio.GeometryType.VISUAL)
        self._data = self.model.createData()
        self._frame = self.model.getFrameId(tool)
        self.lower = np.array(self.model.lowerPositionLimit)
        self.upper = np.array(self.model.upperPositionLimit)

    def tool(self, joints: Array, speeds: Array | None = None) -> ToolPose:
        """Pose of the tool, and its velocity for joint `speeds` (6,) [rad/s] (at rest if None)."""
        model, data = self.model, self._data
        if speeds is None:
            pinocchio.forwardKinematics(model, data, joints)
            velocity = spin = np.zeros(3)
        else:
            pinocchio.forwardKinematics(model, data, joints, speeds)
            aligned = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
            twist = pinocchio.getFrameVelocity(model, data, self._frame, aligned)
            velocity, spin = np.array(twist.linear), np.array(twist.angular)
        placement = pinocchio.updateFramePlacement(model, data, self._frame)
        return ToolPose(np.array(placement.translation), np.array(placement.rotation[:, 0]), velocity, spin)

    def jacobian(self, joints: Array) -> Array:
        """(6, 6) of the tool's centre: linear velocity over angular velocity, in the scene's frame."""
        aligned = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.array(pinocchio.computeFrameJacobian(self.model, self._data, joints, self._frame, aligned))

    def torques(self, joints: Array, speeds: Array, accelerations: Array) -> Array:
        """(6,) inverse dynamics [N m], rotor inertia included."""
        return np.array(pinocchio.rnea(self.model, self._data, joints, speeds, accelerations))

    def reach(self, position: Array, normal: Array, posture: Array) -> Array:
        """Joints that put the tool's centre at `position` (3,) [m], its front facing along `normal` (3,).

        Damped Gauss-Newton from `posture` (6,), which also settles the one redundant direction, so that nearby
        targets have nearby answers.

        Raises:
            Unreachable: No convergence, or a joint limit is crossed.
        """
        joints = np.array(posture, dtype=np.float64)
        for iteration in range(ITERATIONS):
            pose, jacobian = self.tool(joints), self.jacobian(joints)
            # The normal n moves with omega x n, of which only the two components across n are free.
            across = np.array(_tangents(pose.normal))  # (2, 3)
            error = np.concatenate([position - pose.position, across @ normal])  # (5,)
            facing = float(pose.normal @ normal) > 0
            if facing and iteration > PULLS and np.abs(error).max() < 1e-10:
                break
            turning = across @ -_skew(pose.normal) @ jacobian[3:]
            rows = np.vstack([jacobian[:3], turning])  # (5, 6)
            inverse = rows.T @ np.linalg.inv(rows @ rows.T + DAMPING * min(1.0, float(error @ error)) * np.eye(5))
            rest = (POSTURE_GAIN if iteration < PULLS else 0.0) * (posture - joints)
            change = inverse @ error + rest - inverse @ (rows @ rest)
            joints += change * min(1.0, 0.5 / max(float(np.abs(change).max()), 1e-12))
        else:
            raise Unreachable("inverse kinematics does not converge")
        if (joints < self.lower).any() or (joints > self.upper).any():
            raise Unreachable("a joint position limit is crossed")
        return joints

    def speeds_for(self, joints: Array, velocity: Array) -> Array:
        """Smallest joint speeds (6,) [rad/s], relative to the limits, for a `velocity` (3,) of the tool's centre."""
        rows = self.jacobian(joints)[:3] * SPEED_LIMITS
        return np.asarray(SPEED_LIMITS * (rows.T @ np.linalg.solve(rows @ rows.T, velocity)), dtype=np.float64)


def _tangents(normal: Array) -> tuple[Array, Array]:
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _skew(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


class Gains(NamedTuple):
    """Feedback gains of the actuators.

    Attributes:
        stiffness: (6,) [N m/rad].
        damping: (6,) [N m s/rad].
    """

    stiffness: Array
    damping: Array

    @classmethod
    def of(cls, model: Any) -> Gains:
        """The gains of a compiled MuJoCo model."""
        return cls(-np.array(model.actuator_biasprm[:, 1]), -np.array(model.actuator_biasprm[:, 2]))


def tracking_controls(arm: Arm, gains: Gains, swing: JointTrajectory, times: Array) -> Array:
    """Actuator controls (n, 6) [N m] at `times` (n,) [s] from the swing's start.

    Feedback around the swing plus its inverse dynamics, fed forward; actuators.xml has the control law.
    """
    position, velocity, _ = swing.sample(times)
    return np.asarray(gains.stiffness * position + gains.damping * velocity + _feed_forward(arm, swing, times))


def _feed_forward(arm: Arm, swing: JointTrajectory, times: Array) -> Array:
    """Inverse dynamics (n, 6), exact at both ends of each interval of constant acceleration and linear within."""
    last = len(swing.time) - 1
    at = np.minimum(np.searchsorted(swing.time, times, side="right") - 1, last - 1)
    reached = int(at.max()) + 1  # a swing is seldom followed to its end
    begin, end = np.empty((reached, 6)), np.empty((reached, 6))
    for knot, acceleration in enumerate(swing.acceleration[:reached]):
        begin[knot] = arm.torques(swing.position[knot], swing.velocity[knot], acceleration)
        end[knot] = arm.torques(swing.position[knot + 1], swing.velocity[knot + 1], acceleration)
    still = np.zeros(6)
    rest = arm.torques(swing.position[-1], still, still)
    part = ((times - swing.time[at]) / (swing.time[at + 1] - swing.time[at]))[:, None]
    moving = (times < swing.time[-1])[:, None]
    return np.where(moving, begin[at] + part * (end[at] - begin[at]), rest)
