"""An analytic planner for demonstrations and the oracle: where and how to hit a ball so that it lands on the aim."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Protocol, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import SPEED_LIMITS, Arm, Unreachable
from crkr.sim_worker.table_tennis.ball.constants import (
    AIM,
    BALL_RADIUS,
    FACE_OFFSET,
    GRAVITY,
    NET_TOP,
    PADDLE_FRICTION,
    PADDLE_RESTITUTION,
    TABLE_HEIGHT,
)
from crkr.sim_worker.table_tennis.ball.flight import Ball, bounce, flight, fly_to_x

__all__ = ["HOME", "Planner", "Predictor"]

# The hand hangs from a high wrist: fast along x over the whole hitting window and clear of the table. Found by search
# over the arm's postures at the window's centre; `HOME` is the same posture with the paddle 12 cm further back.
POSTURE: Final = np.array([-0.2712, 0.2699, 1.3756, 2.9483, 1.5493, 1.3016])
HOME: Final = np.array([-0.3128, 0.0616, 1.6542, 2.8652, 1.5874, 1.2603])

# (hitting plane x [m], flight time of the return [s]), best first.
CANDIDATES: Final = (
    (-1.45, 0.60),
    (-1.45, 0.68),
    (-1.40, 0.62),
    (-1.52, 0.62),
    (-1.45, 0.54),
    (-1.60, 0.64),
    (-1.40, 0.70),
    (-1.52, 0.70),
    (-1.32, 0.64),
)
# Slow balls that drop behind the table must be hit early, above it: a different stroke, which is not demonstrated.
EARLY: Final = (-1.14, 0.60)
LONGEST: Final = 1.0  # of the prediction [s]
LOWEST: Final = TABLE_HEIGHT + 0.06  # a ball below this cannot be hit [m]
NET_MARGIN: Final = 0.03  # [m]


class Predictor(Protocol):
    """Predicts a ball that is not hit."""

    @property
    def timestep(self) -> float:
        """Between two rows of `path` [s]."""

    def path(self, ball: Array, duration: float) -> Array:
        """Position [m], velocity [m/s] and spin [rad/s] (n + 1, 9), table frame, every timestep from `ball` (6,) on."""


@final
class Planner:
    """Plans returns of balls that fly as `predictor` says, with a rigid impact at the paddle."""

    def __init__(self, arm: Arm, predictor: Predictor) -> None:
        self._arm = arm
        self._predictor = predictor

    def goals(self, ball: Array, aim: tuple[float, float] = AIM, *, early: bool = False) -> Iterator[Array]:
        """Goals (13,) that return a ball, best first, at most ten; whether a swing can get there is not checked.

        Args:
            ball: Position [m] and velocity [m/s] at the snapshot.
            aim: Where the return should land [m].
            early: Also try a stroke above the table, last.
        """
        path = self._predictor.path(ball, LONGEST)
        for plane, duration in (*CANDIDATES, EARLY) if early else CANDIDATES:
            row = int(np.argmax(path[:, 0] <= plane))
            if row == 0 or path[row, 2] < LOWEST:
                continue
            part = (plane - path[row - 1, 0]) / (path[row, 0] - path[row - 1, 0])
            meeting = path[row - 1] + part * (path[row] - path[row - 1])
            hit_time = (row - 1 + part) * self._predictor.timestep
            try:
                yield self._swing(meeting, hit_time, duration, aim)
            except Unreachable:
                continue

    def _swing(self, meeting: Array, hit_time: float, duration: float, aim: tuple[float, float]) -> Array:
        """The goal (13,) that sends a ball with position, velocity and spin `meeting` (9,) to `aim` in `duration`."""
        leaving = _launch(meeting[:3], np.array([*aim, TABLE_HEIGHT + BALL_RADIUS]), duration)
        normal, speed = _face(meeting[3:6], meeting[6:], leaving)
        joints = self._arm.reach(meeting[:3] - FACE_OFFSET * normal, normal, POSTURE)
        speeds = self._arm.speeds_for(joints, speed * normal)
        if (np.abs(speeds) > SPEED_LIMITS).any():
            raise Unreachable("the paddle cannot be that fast there")
        return np.concatenate([joints, speeds, [hit_time]])


def _launch(start: Array, target: Array, duration: float) -> Array:
    """Velocity (3,) that carries a ball from `start` to `target` (3,) in `duration`, over the net.

    Raises:
        Unreachable: That flight would touch the net.
    """
    velocity = (target - start) / duration + [0.0, 0.0, 0.5 * GRAVITY * duration]
    for _ in range(12):
        miss = target - np.array(flight(_ball(start, velocity), duration)[:3])
        velocity = velocity + miss / duration
        if np.abs(miss).max() < 1e-9:
            break
    crossing = fly_to_x(_ball(start, velocity), 0.0)
    if crossing is None or crossing[1].z < NET_TOP + BALL_RADIUS + NET_MARGIN:
        raise Unreachable("the return would touch the net")
    return velocity


def _face(incoming: Array, spin: Array, leaving: Array) -> tuple[Array, float]:
    """Normal (3,) and speed along it [m/s] of a paddle that turns `incoming` (3,) with `spin` into `leaving` (3,).

    Friction's share of the change depends on the normal; the fixed point settles in a few rounds.
    """
    friction, speed, normal = np.zeros(3), 0.0, np.zeros(3)
    for _ in range(30):
        change = leaving - incoming - friction
        normal = change / np.linalg.norm(change)
        approach = float(np.linalg.norm(change)) / (1 + PADDLE_RESTITUTION)
        speed = approach + float(incoming @ normal)
        after, _ = bounce(
            incoming,
            spin,
            normal,
            speed * normal,
            restitution=PADDLE_RESTITUTION,
            friction=PADDLE_FRICTION,
            radius=BALL_RADIUS,
        )
        friction = after - incoming - (1 + PADDLE_RESTITUTION) * approach * normal
        if np.abs(after - leaving).max() < 1e-9:
            break
    return normal, speed


def _ball(position: Array, velocity: Array) -> Ball:
    return Ball(*position.tolist(), *velocity.tolist())
