"""Motion of n joints: limits, trajectories, and the spare time within the limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from crkr.protocol import Array
from crkr.protocol.checks import finite_array
from crkr.protocol.errors import Invalid

__all__ = ["JointLimits", "JointTrajectory", "spare_time"]


@final
@dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of n joints; the arrays are read-only copies.

    Attributes:
        lower: (n,) least positions [rad].
        upper: (n,) greatest positions [rad].
        speed: (n,) greatest speeds [rad/s].
        acceleration: (n,) greatest accelerations in either direction [rad/s^2].

    Raises:
        Invalid: Shapes differ, a value is not finite, a range is empty, or a limit is not positive.
    """

    lower: Array
    upper: Array
    speed: Array
    acceleration: Array

    def __post_init__(self) -> None:
        lower = finite_array(self.lower, "lower", (None,))
        object.__setattr__(self, "lower", lower)
        for name in ("upper", "speed", "acceleration"):
            object.__setattr__(self, name, finite_array(getattr(self, name), name, (lower.size,)))
        if (self.lower >= self.upper).any():
            raise Invalid("lower must be less than upper for every joint", details={"field": "lower"})
        for name in ("speed", "acceleration"):
            if (getattr(self, name) <= 0).any():
                raise Invalid(f"{name} must be positive for every joint", details={"field": name})


@final
@dataclass(frozen=True, slots=True)
class JointTrajectory:
    """A piecewise quadratic motion given by its knots; the arrays are read-only copies.

    Attributes:
        time: (N+1,) strictly increasing knot times from the start of the motion [s].
        position: (N+1, n) joint positions at the knots [rad].
        velocity: (N+1, n) joint velocities at the knots [rad/s].
        acceleration: (N, n) joint accelerations, constant between knots [rad/s^2].

    Raises:
        Invalid: Shapes do not fit each other, a value is not finite, or times do not increase.
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array

    def __post_init__(self) -> None:
        time = finite_array(self.time, "time", (None,))
        position = finite_array(self.position, "position", (time.size, None))
        joints = position.shape[1]
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "velocity", finite_array(self.velocity, "velocity", (time.size, joints)))
        object.__setattr__(
            self, "acceleration", finite_array(self.acceleration, "acceleration", (time.size - 1, joints))
        )
        if time.size < 2 or (np.diff(time) <= 0).any():
            raise Invalid("time must hold at least two strictly increasing knots", details={"field": "time"})

    def sample(self, times: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration at any times.

        Before the first knot the joints rest at the first position; from the last knot on they rest at the last one.
        At a knot the acceleration is that of the interval which begins there.

        Args:
            times: (m,) times from the start of the motion, in any order [s].

        Returns:
            Position (m, n) [rad], velocity (m, n) [rad/s] and acceleration (m, n) [rad/s^2].
        """
        times = np.asarray(times, dtype=np.float64)
        last = self.time.size - 1
        knot = np.searchsorted(self.time, times, side="right") - 1  # (m,), -1 before the motion
        moving = ((knot >= 0) & (knot < last))[:, None]
        at = np.clip(knot, 0, last)
        elapsed = (times - self.time[at])[:, None] * moving  # (m, 1)
        acceleration = self.acceleration[np.minimum(at, last - 1)] * moving
        start_velocity = self.velocity[at] * moving
        position = self.position[at] + elapsed * (start_velocity + 0.5 * elapsed * acceleration)
        return position, start_velocity + elapsed * acceleration, acceleration


def spare_time(limits: JointLimits, way: Array, velocity: Array, hit_time: float) -> float:
    """The hit time minus the least time of the slowest joint [s]; negative if no stroke is in time.

    The fastest way from rest is full acceleration, cruise at the speed limit and full braking. Position limits are
    ignored. A skill can declare this number as an outcome, as it measures how far a refused goal was out of reach.

    Args:
        limits: Of n joints.
        way: (n,) from the start to the goal's joint positions [rad].
        velocity: (n,) joint velocities at the hit, within the speed limits [rad/s].
        hit_time: Time of the hit [s].
    """
    most, top = limits.acceleration, limits.speed
    forward = np.where(way >= velocity * np.abs(velocity) / (2 * most), 1.0, -1.0)  # direction of the first motion
    way, end = forward * way, forward * velocity
    peak = np.minimum(np.sqrt(np.maximum(most * way + 0.5 * end**2, 0.0)), top)
    cruise = (way - (2 * peak**2 - end**2) / (2 * most)) / top  # 0 where the peak is below the speed limit
    return float((hit_time - (2 * peak - end) / most - cruise).min())
