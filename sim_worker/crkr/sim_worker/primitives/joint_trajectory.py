"""A motion of several joints with constant accelerations between knots, evaluated exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol.checks import finite_array
from crkr.protocol.errors import Invalid

__all__ = ["JointTrajectory"]

Floats = NDArray[np.float64]


@final
@dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Knots of a piecewise quadratic motion; the arrays are read-only copies.

    Attributes:
        time: (N+1,) strictly increasing knot times from the start of the motion [s].
        position: (N+1, n) joint positions at the knots [rad].
        velocity: (N+1, n) joint velocities at the knots [rad/s].
        acceleration: (N, n) joint accelerations, constant between knots [rad/s^2].

    Raises:
        Invalid: Shapes that do not belong together, a value that is not finite, or times that do not increase.
    """

    time: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats

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

    def sample(self, times: Floats) -> tuple[Floats, Floats, Floats]:
        """Position, velocity and acceleration at any times.

        Before the first knot the joints wait at the first position; from the last knot on they rest at the last one.
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
