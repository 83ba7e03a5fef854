"""Movement primitives for any skill: strokes of an arm by a quadratic program, and acceleration profiles to follow."""

from __future__ import annotations

from crkr.sim_worker.primitives.joint_motion import JointLimits, JointTrajectory, spare_time
from crkr.sim_worker.primitives.profiles import demonstrated_profile, wind_up
from crkr.sim_worker.primitives.stroke import Infeasible, Primitive

__all__ = [
    "Infeasible",
    "JointLimits",
    "JointTrajectory",
    "Primitive",
    "demonstrated_profile",
    "spare_time",
    "wind_up",
]
