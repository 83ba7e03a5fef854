"""The ball of table tennis between and at its impacts: flight, and a sphere on a moving plane with Coulomb friction."""

from __future__ import annotations

from typing import Final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.simulation.flight import STEP, Air, Ball, Curl
from crkr.sim_worker.table_tennis.ball.constants import DRAG, MAGNUS, SPIN_INERTIA

__all__ = ["AIR", "STEP", "Ball", "Curl", "bounce", "curl_of", "flight", "fly", "fly_to_height", "fly_to_x"]

AIR: Final = Air(DRAG)
fly, flight, fly_to_height, fly_to_x = AIR.fly, AIR.flight, AIR.fly_to_height, AIR.fly_to_x


def curl_of(spin: Array) -> Curl:
    """The lift of a ball with `spin` (3,) [rad/s], as `fly` takes it; spin lasts from one impact to the next."""
    x, y, z = (MAGNUS * spin).tolist()
    return x, y, z


def bounce(
    velocity: Array,
    spin: Array,
    normal: Array,
    surface: Array,
    *,
    restitution: float,
    friction: float,
    radius: float,
) -> tuple[Array, Array]:
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
