"""The result of a swing in an environment: a `Play`, which the tracker judges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol, final

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import ToolPose
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.table_tennis.ball.flight import Ball, Curl

__all__ = ["FOLLOW", "Environment", "Play"]

FOLLOW: Final = 0.12  # how long the swing is followed after the hit time [s]; from then on the ball only flies


@final
@dataclass(frozen=True, slots=True)
class Play:
    """One swing at one ball, in the table frame, times from the snapshot.

    Attributes:
        hit_time: When the goal asked for the hit [s].
        ball: The ball at that time.
        untouched: (3,) position of the ball at that time without an earlier hit [m].
        paddle: The paddle at that time, from measured joints.
        touched: Whether ball and paddle met.
        end: Until when the swing was followed [s].
        after: The ball then.
        time: (n,) [s] of the recorded motion below.
        joints: (n, 6) measured joint positions [rad].
        path: (n, 3) ball positions [m].
        curl: Lift of the ball from `end` on, as `fly` takes it.
    """

    hit_time: float
    ball: Ball
    untouched: Array
    paddle: ToolPose
    touched: bool
    end: float
    after: Ball
    time: Array
    joints: Array
    path: Array
    curl: Curl = None


class Environment(Protocol):
    """A way to execute swings."""

    def play(self, ball: Array, swing: JointTrajectory, hit_time: float) -> Play:
        """Executes `swing` against the ball that was `ball` (6,) at time 0; raises `Diverged` if that fails."""
