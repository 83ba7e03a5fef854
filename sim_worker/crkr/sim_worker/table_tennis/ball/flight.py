"""The ball between and at its impacts: flight with drag, and a sphere on a moving plane with Coulomb friction.

Coordinates of a `Ball` may be numbers or equally shaped arrays, so that one integrator serves one ball and thousands.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.table_tennis.ball.constants import DRAG, GRAVITY, MAGNUS, SPIN_INERTIA

__all__ = ["Ball", "Curl", "bounce", "curl_of", "flight", "fly", "fly_to_height", "fly_to_x"]

Floats = NDArray[np.float64]
Curl = tuple[float, float, float] | None

STEP = 0.02  # [s]; fourth order: 1e-7 m over a rally
LONGEST_FLIGHT = 3.0  # [s]


class Ball(NamedTuple):
    """Position [m] and velocity [m/s] of the ball's centre in the table frame."""

    x: Any
    y: Any
    z: Any
    vx: Any
    vy: Any
    vz: Any


def curl_of(spin: Floats) -> Curl:
    """The lift of a ball with `spin` (3,) [rad/s], as `fly` takes it; spin lasts from one impact to the next."""
    x, y, z = (MAGNUS * spin).tolist()
    return x, y, z


def fly(ball: Ball, duration: Any, curl: Curl = None) -> Ball:
    """One classical Runge-Kutta step of flight under gravity and quadratic drag.

    Args:
        ball: Coordinates, numbers or arrays.
        duration: [s], at most a few hundredths for full accuracy; a number or an array; negative goes back in time.
        curl: Vector whose cross product with the velocity is the lift's acceleration [1/s]; None for no lift.
    """
    x, y, z, vx, vy, vz = ball
    half = duration / 2
    ax1, ay1, az1 = _acceleration(vx, vy, vz, curl)
    vx2, vy2, vz2 = vx + half * ax1, vy + half * ay1, vz + half * az1
    ax2, ay2, az2 = _acceleration(vx2, vy2, vz2, curl)
    vx3, vy3, vz3 = vx + half * ax2, vy + half * ay2, vz + half * az2
    ax3, ay3, az3 = _acceleration(vx3, vy3, vz3, curl)
    vx4, vy4, vz4 = vx + duration * ax3, vy + duration * ay3, vz + duration * az3
    ax4, ay4, az4 = _acceleration(vx4, vy4, vz4, curl)
    sixth = duration / 6
    return Ball(
        x + sixth * (vx + 2 * (vx2 + vx3) + vx4),
        y + sixth * (vy + 2 * (vy2 + vy3) + vy4),
        z + sixth * (vz + 2 * (vz2 + vz3) + vz4),
        vx + sixth * (ax1 + 2 * (ax2 + ax3) + ax4),
        vy + sixth * (ay1 + 2 * (ay2 + ay3) + ay4),
        vz + sixth * (az1 + 2 * (az2 + az3) + az4),
    )


def flight(ball: Ball, duration: float, curl: Curl = None) -> Ball:
    """The ball after any `duration` [s], in steps short enough for full accuracy."""
    steps = max(1, int(np.ceil(abs(duration) / STEP)))
    for _ in range(steps):
        ball = fly(ball, duration / steps, curl)
    return ball


def fly_to_height(ball: Ball, height: float, curl: Curl = None) -> tuple[float, Ball] | None:
    """When [s] and how one ball first comes down through `height` [m]; None if not within three seconds."""
    for time, before, after in _steps(ball, curl):
        if after.z <= height < before.z:
            part = _root(before, "z", height, curl)
            return time + part, fly(before, part, curl)
    return None


def fly_to_x(ball: Ball, x: float, curl: Curl = None) -> tuple[float, Ball] | None:
    """When [s] and how one ball first crosses the plane at `x` [m], either way; None if it reaches the floor first."""
    for time, before, after in _steps(ball, curl):
        if (before.x - x) * (after.x - x) <= 0 and before.x != after.x:
            part = _root(before, "x", x, curl)
            return time + part, fly(before, part, curl)
        if after.z < 0 and after.vz < 0:
            return None
    return None


def bounce(
    velocity: Floats,
    spin: Floats,
    normal: Floats,
    surface: Floats,
    *,
    restitution: float,
    friction: float,
    radius: float,
) -> tuple[Floats, Floats]:
    """Impact of a free sphere on a plane of infinite mass, Coulomb friction, sliding or sticking to the end.

    Args:
        velocity: (..., 3) of the centre [m/s].
        spin: (..., 3) angular velocity [rad/s].
        normal: (..., 3) unit normal, from the plane to the ball.
        surface: (..., 3) velocity of the plane [m/s].
        restitution: Normal speed after over before.
        friction: Coulomb coefficient.
        radius: [m].

    Returns:
        Velocity and spin after the impact; unchanged if the ball already leaves the plane.
    """
    relative = velocity - surface
    approach = np.maximum(-(relative * normal).sum(axis=-1, keepdims=True), 0.0)
    arm = -radius * normal
    slip = relative + approach * normal + np.cross(spin, arm)
    speed = np.sqrt((slip * slip).sum(axis=-1, keepdims=True))
    # The impulse that stops the slip, for a sphere that it spins up as well as slows down.
    stop = speed * SPIN_INERTIA / (1 + SPIN_INERTIA)
    change = np.minimum(friction * (1 + restitution) * approach, stop)
    tangential = -slip * (change / np.maximum(speed, 1e-300))
    after = velocity + (1 + restitution) * approach * normal + tangential
    return after, spin + np.cross(arm, tangential) / (SPIN_INERTIA * radius**2)


def _acceleration(vx: Any, vy: Any, vz: Any, curl: Curl) -> tuple[Any, Any, Any]:
    pull = -DRAG * (vx * vx + vy * vy + vz * vz) ** 0.5
    if curl is None:
        return pull * vx, pull * vy, pull * vz - GRAVITY
    x, y, z = curl
    return pull * vx + y * vz - z * vy, pull * vy + z * vx - x * vz, pull * vz + x * vy - y * vx - GRAVITY


def _steps(ball: Ball, curl: Curl) -> Iterator[tuple[float, Ball, Ball]]:
    for index in range(int(LONGEST_FLIGHT / STEP)):
        after = fly(ball, STEP, curl)
        yield index * STEP, ball, after
        ball = after


def _root(ball: Ball, axis: str, value: float, curl: Curl) -> float:
    """Duration [s] within one integration step after which coordinate `axis` reaches `value`, by Newton's method."""
    duration = 0.0
    for _ in range(8):
        there = fly(ball, duration, curl)
        duration -= (getattr(there, axis) - value) / getattr(there, "v" + axis)
        duration = min(max(duration, 0.0), STEP)
    return duration
