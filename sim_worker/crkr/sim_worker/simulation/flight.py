"""A ball in flight, under gravity, drag and, where it spins, lift.

Coordinates of a `Ball` may be numbers or equally shaped arrays, so that one integrator serves one ball and thousands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, final

import numpy as np

from crkr.protocol import Array

__all__ = ["GRAVITY", "STEP", "Air", "Ball", "Curl", "drag_of"]

Curl = tuple[float, float, float] | None

GRAVITY: Final = 9.81  # [m/s^2]
AIR_DENSITY: Final = 1.2  # [kg/m^3]
DRAG_COEFFICIENT: Final = 0.47  # of a smooth sphere
STEP: Final = 0.02  # [s]; fourth order: 1e-7 m over a rally
LONGEST_FLIGHT: Final = 3.0  # [s]


def drag_of(radius: float, mass: float) -> float:
    """Drag of a sphere, its deceleration over its squared speed [1/m]."""
    return 0.5 * AIR_DENSITY * DRAG_COEFFICIENT * 3.141592653589793 * radius**2 / mass


class Ball(NamedTuple):
    """Position [m] and velocity [m/s] of the ball's centre in the scene's frame."""

    x: Any
    y: Any
    z: Any
    vx: Any
    vy: Any
    vz: Any


@final
@dataclass(frozen=True, slots=True)
class Air:
    """Flight through still air.

    Attributes:
        drag: Deceleration over squared speed [1/m], see `drag_of`.
    """

    drag: float

    def fly(self, ball: Ball, duration: Any, curl: Curl = None) -> Ball:
        """One classical Runge-Kutta step of flight under gravity and quadratic drag.

        Args:
            ball: Coordinates, numbers or arrays.
            duration: [s], at most a few hundredths for full accuracy; a number or an array; negative goes back in time.
            curl: Vector whose cross product with the velocity is the lift's acceleration [1/s]; None for no lift.
        """
        x, y, z, vx, vy, vz = ball
        half = duration / 2
        ax1, ay1, az1 = self._acceleration(vx, vy, vz, curl)
        vx2, vy2, vz2 = vx + half * ax1, vy + half * ay1, vz + half * az1
        ax2, ay2, az2 = self._acceleration(vx2, vy2, vz2, curl)
        vx3, vy3, vz3 = vx + half * ax2, vy + half * ay2, vz + half * az2
        ax3, ay3, az3 = self._acceleration(vx3, vy3, vz3, curl)
        vx4, vy4, vz4 = vx + duration * ax3, vy + duration * ay3, vz + duration * az3
        ax4, ay4, az4 = self._acceleration(vx4, vy4, vz4, curl)
        sixth = duration / 6
        return Ball(
            x + sixth * (vx + 2 * (vx2 + vx3) + vx4),
            y + sixth * (vy + 2 * (vy2 + vy3) + vy4),
            z + sixth * (vz + 2 * (vz2 + vz3) + vz4),
            vx + sixth * (ax1 + 2 * (ax2 + ax3) + ax4),
            vy + sixth * (ay1 + 2 * (ay2 + ay3) + ay4),
            vz + sixth * (az1 + 2 * (az2 + az3) + az4),
        )

    def flight(self, ball: Ball, duration: float, curl: Curl = None) -> Ball:
        """The ball after any `duration` [s], in steps short enough for full accuracy."""
        steps = max(1, int(np.ceil(abs(duration) / STEP)))
        for _ in range(steps):
            ball = self.fly(ball, duration / steps, curl)
        return ball

    def path(self, ball: Ball, duration: float, interval: float, curl: Curl = None) -> tuple[Array, Array]:
        """Times (n,) [s], at most `interval` apart, and positions (n, 3) [m] of a flight, for drawing."""
        count = max(1, int(np.ceil(duration / interval)))
        points = [ball]
        for _ in range(count):
            points.append(self.fly(points[-1], duration / count, curl))
        return np.linspace(0.0, duration, count + 1), np.array([point[:3] for point in points])

    def fly_to_height(self, ball: Ball, height: float, curl: Curl = None) -> tuple[float, Ball] | None:
        """When [s] and how one ball first comes down through `height` [m]; None if not within three seconds."""
        for time, before, after in self._steps(ball, curl):
            if after.z <= height < before.z:
                part = self._root(before, "z", height, curl)
                return time + part, self.fly(before, part, curl)
        return None

    def fly_to_x(self, ball: Ball, x: float, curl: Curl = None, *, floor: float = 0.0) -> tuple[float, Ball] | None:
        """When [s] and how a ball crosses the plane at `x` [m], either way; None if it falls under `floor` first."""
        for time, before, after in self._steps(ball, curl):
            if (before.x - x) * (after.x - x) <= 0 and before.x != after.x:
                part = self._root(before, "x", x, curl)
                return time + part, self.fly(before, part, curl)
            if after.z < floor and after.vz < 0:
                return None
        return None

    def _acceleration(self, vx: Any, vy: Any, vz: Any, curl: Curl) -> tuple[Any, Any, Any]:
        pull = -self.drag * (vx * vx + vy * vy + vz * vz) ** 0.5
        if curl is None:
            return pull * vx, pull * vy, pull * vz - GRAVITY
        x, y, z = curl
        return pull * vx + y * vz - z * vy, pull * vy + z * vx - x * vz, pull * vz + x * vy - y * vx - GRAVITY

    def _steps(self, ball: Ball, curl: Curl) -> Iterator[tuple[float, Ball, Ball]]:
        for index in range(int(LONGEST_FLIGHT / STEP)):
            after = self.fly(ball, STEP, curl)
            yield index * STEP, ball, after
            ball = after

    def _root(self, ball: Ball, axis: str, value: float, curl: Curl) -> float:
        """Duration [s] within an integration step after which coordinate `axis` reaches `value`, by Newton's method."""
        duration = 0.0
        for _ in range(8):
            there = self.fly(ball, duration, curl)
            duration -= (getattr(there, axis) - value) / getattr(there, "v" + axis)
            duration = min(max(duration, 0.0), STEP)
        return duration
