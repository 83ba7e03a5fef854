"""The game-state tracker: cost, outcome, success and reason of a play, and its motion up to where it was decided."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.simulation.motion import INTERVAL, Motion, interpolated
from crkr.sim_worker.table_tennis.ball.constants import (
    AIM,
    BALL_RADIUS,
    FACE_OFFSET,
    NET_HALF_LENGTH,
    NET_TOP,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_HEIGHT,
)
from crkr.sim_worker.table_tennis.ball.flight import AIR, Ball, Curl, fly_to_height, fly_to_x
from crkr.sim_worker.table_tennis.environments.play import Play

__all__ = ["COST_WIDTH", "Verdict", "cost_of", "judge", "motion"]

# The paper sets a^2 = 6 cm, read as 6 cm^2: a ball at the paddle's edge then costs 0.99, as the text wants.
COST_WIDTH: Final = 6e-4**0.5  # a [m]
TOUCH_HEIGHT: Final = TABLE_HEIGHT + BALL_RADIUS


@final
@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement of one play.

    Attributes:
        cost: [Cardoso2017, eq. 8] of the distance from the ball to where a ball touching the face's centre would be.
        paper: Hit, and the next bounce is on the table with the ball moving away from the robot.
        strict: Hit, over the net, first bounce on the opponent's half.
        reason: "returned", or why not: "miss", "backwards", "below" (left under table height), "net", "own_half",
            "long", "short" (both on the floor) or "out" (beside the table).
        outcome: (5,) ball minus face point at the hit time and landing point minus the aim [m]; NaN: not observed.
        landing: Time [s] after the swing's end and ball as it comes down to table height; None if it does not.
    """

    cost: float
    paper: bool
    strict: bool
    reason: str
    outcome: Array
    landing: tuple[float, Ball] | None


def judge(play: Play) -> Verdict:
    """Judges a play by both criteria."""
    face = play.paddle.position + FACE_OFFSET * play.paddle.normal
    cost = float(cost_of(float(np.linalg.norm(np.array(play.ball[:3]) - face))))
    landing = fly_to_height(play.after, TOUCH_HEIGHT, play.curl) if play.touched else None
    error = (landing[1].x - AIM[0], landing[1].y - AIM[1]) if landing else (np.nan, np.nan)
    outcome = np.array([*(play.untouched - face), *error])
    reason = _reason(play, landing)
    own_half = reason == "own_half" and landing is not None and landing[1].vx > 0
    strict = reason == "returned"
    return Verdict(cost, strict or own_half, strict, reason, outcome, landing)


def cost_of(distance: Array | float) -> Array | np.float64:
    """Saturating cost in [0, 1] of distances [m]  [Cardoso2017, eq. 8]."""
    return np.negative(np.expm1(-0.5 * (distance / COST_WIDTH) ** 2))


def _reason(play: Play, landing: tuple[float, Ball] | None) -> str:
    if not play.touched:
        return "miss"
    if play.after.vx <= 0:
        return "backwards"
    if landing is None:  # It left below the table's height.
        return "below"
    spot = landing[1]
    if spot.x >= 0 and not _clears_net(play.after, play.curl):
        return "net"
    if abs(spot.y) > TABLE_HALF_WIDTH:
        return "out"
    if spot.x > TABLE_HALF_LENGTH:
        return "long"
    if spot.x < -TABLE_HALF_LENGTH:
        return "short"
    return "returned" if spot.x >= 0 else "own_half"


def _clears_net(ball: Ball, curl: Curl) -> bool:
    crossing = fly_to_x(ball, 0.0, curl)
    if crossing is None:
        return False
    return bool(crossing[1].z > NET_TOP + BALL_RADIUS or abs(crossing[1].y) > NET_HALF_LENGTH + BALL_RADIUS)


def motion(swing: JointTrajectory, play: Play, verdict: Verdict, interval: float = INTERVAL) -> Motion:
    """The trial from the snapshot until the ball comes down, or as far as it was followed if it was not touched.

    Up to `play.end` everything is as simulated; from then on the arm follows its swing and the ball flies freely.

    Args:
        swing: The executed swing.
        play: What happened.
        verdict: How it ended.
        interval: Longest time between two rows [s].
    """
    time = np.arange(0.0, play.end, interval)
    moved = Motion(time, interpolated(time, play.time, play.joints), interpolated(time, play.time, play.path))
    if verdict.landing is None:
        return moved
    return moved.continued(swing, AIR.path(play.after, verdict.landing[0], interval, play.curl), play.end)
