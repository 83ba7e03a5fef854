"""How early a goal could be met: what tells by how much a swing is out of reach, before anything moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.primitives.stroke import JointLimits

__all__ = ["spare_time"]

Floats = NDArray[np.float64]


def spare_time(limits: JointLimits, way: Floats, velocity: Floats, hit_time: float) -> float:
    """The hit time less the least time that the slowest joint needs [s]; negative where no swing can be in time.

    The quickest way from rest is full acceleration, cruise at the speed limit and full braking. Limits of position are
    left out.

    Args:
        limits: Of n joints.
        way: (n,) from the start to the goal's joint positions [rad].
        velocity: (n,) joint velocities at the hit, within the speed limits [rad/s].
        hit_time: Time of the hit [s].
    """
    most, top = limits.acceleration, limits.speed
    forward = np.where(way >= velocity * np.abs(velocity) / (2 * most), 1.0, -1.0)  # how it has to set off
    way, end = forward * way, forward * velocity
    peak = np.minimum(np.sqrt(np.maximum(most * way + 0.5 * end**2, 0.0)), top)
    cruise = (way - (2 * peak**2 - end**2) / (2 * most)) / top  # 0 where the peak is below the speed limit
    return float((hit_time - (2 * peak - end) / most - cruise).min())
