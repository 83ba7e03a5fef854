"""Controls that track a swing: feedback around it plus its inverse dynamics, fed forward."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.primitives.joint_motion import JointTrajectory

__all__ = ["Gains", "controls"]


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


def controls(arm: Arm, gains: Gains, swing: JointTrajectory, times: Array) -> Array:
    """Actuator controls (n, 6) [N m] at `times` (n,) [s] from the swing's start; scene.xml has the control law."""
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
