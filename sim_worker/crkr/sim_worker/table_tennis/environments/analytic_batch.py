"""The analytic environment for thousands of balls at once.

It has the closed-form swing and every formula of flight and impact of the scalar environment, with three differences:
a swing whose limits bind is refused only where full acceleration would not suffice, and moves near the hit as if no
limit bound; only the blade is checked against the table, at the hit and at the end of the swing; a touch more than
60 ms from the hit time does not count.
"""

from __future__ import annotations

from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Array
from crkr.sim_worker.arm.collision import MARGIN
from crkr.sim_worker.arm.dynamics import ACCELERATION_LIMITS, SPEED_LIMITS, Arm
from crkr.sim_worker.arm.forward_kinematics import Chain, Faces
from crkr.sim_worker.primitives.quadratic_program import StrokeProgram
from crkr.sim_worker.table_tennis.ball.constants import (
    BALL_RADIUS,
    FACE_OFFSET,
    GRAVITY,
    NET_HALF_LENGTH,
    NET_TOP,
    PADDLE_FRICTION,
    PADDLE_RADIUS,
    PADDLE_RESTITUTION,
    TABLE_FRICTION,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_HEIGHT,
    TABLE_RESTITUTION,
)
from crkr.sim_worker.table_tennis.ball.flight import Ball, bounce, fly
from crkr.sim_worker.table_tennis.planner import HOME
from crkr.sim_worker.table_tennis.tracker import TOUCH_HEIGHT, cost_of

__all__ = ["AnalyticBatch", "BatchResult"]

Flags = NDArray[np.bool_]

PIECES: Final = 6  # integration steps of a flight; 1e-5 m over a second
LONGEST_FLIGHT: Final = 3.0  # [s], as for one ball
LONGEST_TOUCH: Final = 0.06  # [s] from the hit time
INTERVALS, HIT_INTERVAL, SMOOTHNESS = 45, 25, 20.0  # the defaults of `Primitive`


class BatchResult(NamedTuple):
    """The results of b swings.

    Attributes:
        executed: (b,) whether the swing was allowed.
        cost: (b,) [Cardoso2017, eq. 8]; NaN where not executed.
        touched: (b,) whether ball and paddle met.
        paper: (b,) success by the paper's criterion.
        strict: (b,) success by the strict criterion.
    """

    executed: Flags
    cost: Array
    touched: Flags
    paper: Flags
    strict: Flags


@final
class AnalyticBatch:
    """Plays many balls by formulas alone."""

    def __init__(self, arm: Arm) -> None:
        self._chain = Chain(arm)
        program = StrokeProgram(INTERVALS, HIT_INTERVAL, SMOOTHNESS)
        self._accelerations = program.spread  # (N, 3): of the swing, per unit of each target
        self._way = program.limited[2 * INTERVALS : 3 * INTERVALS] @ program.spread  # (N, 3)

    def play(self, balls: Array, goals: Array) -> BatchResult:
        """Executes `goals` (b, 13) against the balls measured as `balls` (b, 6)."""
        joints, speeds, hit_time = goals[:, :6], goals[:, 6:12], goals[:, 12]
        step = (hit_time / HIT_INTERVAL)[:, None]
        targets = np.stack([joints - HOME, speeds * step])  # (2, b, 6); the third target, rest at the end, is zero
        executed = self._feasible(targets[0], speeds, hit_time) & self._clear(targets, joints, speeds)
        incoming, spin = _incoming(balls, hit_time)
        faces = self._chain.faces(joints, speeds)
        face = faces.position + FACE_OFFSET * faces.normal
        delay, touching, met = self._meeting(incoming, faces, targets, joints, speeds, step)
        touched = met & executed
        at_touch = fly(incoming, delay)
        after = _struck(at_touch, spin, touching)
        early = met & (delay < 0)
        at_hit = fly(after, np.where(early, -delay, 0.0))
        ball = Ball(*(np.where(early, hit, free) for hit, free in zip(at_hit, incoming, strict=True)))
        distance = np.sqrt(((np.stack(ball[:3], axis=1) - face) ** 2).sum(axis=1))
        cost = np.where(executed, cost_of(distance), np.nan)
        paper, strict = _returned(after)
        return BatchResult(executed, cost, touched, touched & paper, touched & strict)

    def _feasible(self, way: Array, speeds: Array, hit_time: Array) -> Flags:
        """Whether full acceleration, cruise and full braking could do it: necessary, and sufficient if none binds."""
        limit, fastest = ACCELERATION_LIMITS, SPEED_LIMITS
        time = hit_time[:, None]
        fine = (np.abs(speeds) <= fastest) & (np.abs(speeds) <= limit * time * (INTERVALS / HIT_INTERVAL - 1))
        for sign in (1.0, -1.0):
            end = sign * speeds
            peak = np.minimum(fastest, 0.5 * (limit * time + end))
            cruise = time - (2 * peak - end) / limit
            fine &= sign * way <= (2 * peak**2 - end**2) / (2 * limit) + peak * cruise
        return np.asarray(fine.all(axis=1))

    def _clear(self, targets: Array, joints: Array, speeds: Array) -> Flags:
        """Whether the blade keeps off the table at the hit and at the end of the swing."""
        end = HOME + np.tensordot(self._way[-1, :2], targets, 1)
        clear = np.ones(len(joints), dtype=bool)
        for posture in (joints, end):
            faces = self._chain.faces(posture, speeds)
            reach = PADDLE_RADIUS * np.sqrt(np.maximum(1 - faces.normal**2, 0.0))  # (b, 3): the disc's half extents
            low = faces.position[:, 2] - reach[:, 2] < TABLE_HEIGHT + MARGIN
            over = faces.position[:, 0] + reach[:, 0] > -TABLE_HALF_LENGTH - MARGIN
            beside = np.abs(faces.position[:, 1]) - reach[:, 1] > TABLE_HALF_WIDTH + MARGIN
            clear &= ~(low & over & ~beside)
        return clear

    def _meeting(
        self, incoming: Ball, faces: Faces, targets: Array, joints: Array, speeds: Array, step: Array
    ) -> tuple[Array, Faces, Flags]:
        """When, relative to the hit time, each ball meets its paddle, the paddle then, and whether it does."""
        scaled = [np.tensordot(self._accelerations[row, :2], targets, 1) for row in (HIT_INTERVAL - 1, HIT_INTERVAL)]
        before, behind = (row / step**2 for row in scaled)  # (b, 6) [rad/s^2]
        delay = np.zeros(len(joints))
        for _ in range(3):
            ball = fly(incoming, delay)
            gap, closing = _gap(ball, faces)
            delay = np.clip(delay + gap / np.maximum(closing, 0.1), -LONGEST_TOUCH, LONGEST_TOUCH)
            late = delay[:, None]
            pull = np.where(late < 0, before, behind)
            faces = self._chain.faces(joints + late * (speeds + 0.5 * late * pull), speeds + late * pull)
        ball = fly(incoming, delay)
        gap, closing = _gap(ball, faces)
        apart = np.stack(ball[:3], axis=1) - faces.position
        along = (apart * faces.normal).sum(axis=1)[:, None]
        aside = np.sqrt(((apart - along * faces.normal) ** 2).sum(axis=1))
        return delay, faces, (np.abs(gap) < 2e-3) & (closing > 0) & (aside <= PADDLE_RADIUS)


def _gap(ball: Ball, faces: Faces) -> tuple[Array, Array]:
    """Distances (b,) between ball and front face [m], and how fast they close [m/s]."""
    apart = np.stack(ball[:3], axis=1) - faces.position
    closing = np.stack(ball[3:], axis=1) - faces.velocity - np.cross(faces.spin, apart)
    return (apart * faces.normal).sum(axis=1) - FACE_OFFSET, -(closing * faces.normal).sum(axis=1)


def _struck(ball: Ball, spin: Array, faces: Faces) -> Ball:
    at = np.stack(ball[:3], axis=1) - BALL_RADIUS * faces.normal - faces.position
    velocity, _ = bounce(
        np.stack(ball[3:], axis=1),
        spin,
        faces.normal,
        faces.velocity + np.cross(faces.spin, at),
        restitution=PADDLE_RESTITUTION,
        friction=PADDLE_FRICTION,
        radius=BALL_RADIUS,
    )
    return Ball(*ball[:3], *velocity.T)


def _incoming(balls: Array, until: Array) -> tuple[Ball, Array]:
    """The balls at times `until` (b,) [s] and their spins (b, 3), after at most one bounce on the table."""
    start = Ball(*balls.T)
    time, landed = _fall(start, TOUCH_HEIGHT)
    velocity, spin = bounce(
        np.stack(landed[3:], axis=1),
        np.zeros((len(balls), 3)),
        np.array([0.0, 0.0, 1.0]),
        np.zeros(3),
        restitution=TABLE_RESTITUTION,
        friction=TABLE_FRICTION,
        radius=BALL_RADIUS,
    )
    return _glide(Ball(*landed[:3], *velocity.T), until - time), spin


def _returned(ball: Ball) -> tuple[Flags, Flags]:
    """Success (b,) of leaving balls by the paper's and by the strict criterion, as `tracker` has them."""
    _, landed = _fall(ball, TOUCH_HEIGHT)
    away = (ball.vx > 0) & ((ball.z > TOUCH_HEIGHT) | (ball.vz > 0)) & np.isfinite(landed.x)
    on_table = (np.abs(landed.x) <= TABLE_HALF_LENGTH) & (np.abs(landed.y) <= TABLE_HALF_WIDTH)
    crossing = _glide(ball, np.minimum(-ball.x / np.maximum(ball.vx, 0.1), LONGEST_FLIGHT))
    for _ in range(2):
        crossing = fly(crossing, np.clip(-crossing.x / np.maximum(crossing.vx, 0.1), -0.2, 0.2))
    over = (crossing.z > NET_TOP + BALL_RADIUS) | (np.abs(crossing.y) > NET_HALF_LENGTH + BALL_RADIUS)
    strict = away & on_table & (landed.x >= 0) & over
    return strict | (away & on_table & (landed.x < 0) & (landed.vx > 0)), strict


def _fall(ball: Ball, height: float) -> tuple[Array, Ball]:
    """Times [s] and states at which balls come down through `height`: the parabola's time, then Newton's method."""
    root = np.sqrt(np.maximum(ball.vz**2 + 2 * GRAVITY * (ball.z - height), 0.0))
    time = np.maximum((ball.vz + root) / GRAVITY, 0.0)
    landed = _glide(ball, time)
    for _ in range(2):
        change = np.clip((landed.z - height) / np.maximum(-landed.vz, 0.1), -0.1, 0.1)
        time, landed = time + change, fly(landed, change)
    return time, landed


def _glide(ball: Ball, duration: Array) -> Ball:
    for _ in range(PIECES):
        ball = fly(ball, duration / PIECES)
    return ball
