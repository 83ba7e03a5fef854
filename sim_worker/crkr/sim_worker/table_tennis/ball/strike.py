"""The impact of a ball on a moving paddle, by formulas: when it happens, and how the ball leaves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm, ToolPose
from crkr.sim_worker.table_tennis.ball.constants import (
    BALL_RADIUS,
    FACE_OFFSET,
    PADDLE_FRICTION,
    PADDLE_RADIUS,
    PADDLE_RESTITUTION,
)
from crkr.sim_worker.table_tennis.ball.flight import Ball, bounce, flight
from crkr.sim_worker.table_tennis.ball.incoming import Incoming
from crkr.sim_worker.table_tennis.environments.play import Play

__all__ = ["FaceMotion", "meeting", "played", "struck"]


class FaceMotion(NamedTuple):
    """The motion of arm and paddle, in rows of successive times.

    Attributes:
        times: (n,) [s], equally spaced from 0.
        joints: (n, 6) [rad].
        speeds: (n, 6) [rad/s].
        centres: (n, 3) of the paddle [m].
        normals: (n, 3) of its front face.
    """

    times: Array
    joints: Array
    speeds: Array
    centres: Array
    normals: Array

    def arm_at(self, row: float) -> tuple[Array, Array]:
        """Joints (6,) and speeds (6,) between two rows."""
        first = min(int(row), len(self.times) - 2)
        part = row - first
        return (
            self.joints[first] + part * (self.joints[first + 1] - self.joints[first]),
            self.speeds[first] + part * (self.speeds[first + 1] - self.speeds[first]),
        )


def played(arm: Arm, incoming: Incoming, face: FaceMotion, hit_time: float) -> Play:
    """The play of a ball and a given motion of the paddle."""
    path = incoming.positions(face.times)
    step = float(face.times[1])
    row = meeting(path, face.centres, face.normals)
    undisturbed, _ = incoming.at(hit_time)
    paddle = arm.tool(*face.arm_at(hit_time / step))
    end = float(face.times[-1])
    after, spin = incoming.at(end)
    ball = undisturbed
    if row is not None:
        contact = row * step
        after, spin = struck(*incoming.at(contact), arm.tool(*face.arm_at(row)))
        if contact < hit_time:
            ball = flight(after, hit_time - contact, incoming.curl(spin))
        first = int(row) + 1
        path = np.concatenate([path[:first], [after[:3]]])
        face = face._replace(times=np.append(face.times[:first], contact), joints=face.joints[: first + 1])
        end = contact
    return Play(
        hit_time=hit_time,
        ball=ball,
        untouched=np.array(undisturbed[:3]),
        paddle=paddle,
        touched=row is not None,
        end=end,
        after=after,
        time=face.times,
        joints=face.joints,
        path=path,
        curl=incoming.curl(spin),
    )


def meeting(balls: Array, centres: Array, normals: Array) -> float | None:
    """First row, with its fraction, at which the ball touches the paddle's front face.

    Only crossings of the face's plane from the front and within the blade count: hits with the rim or the back do not.

    Args:
        balls: (n, 3) positions of the ball's centre at successive times [m].
        centres: (n, 3) of the paddle's centre [m].
        normals: (n, 3) of its front face.
    """
    apart = balls - centres
    along = np.einsum("ij,ij->i", apart, normals)
    gap = along - FACE_OFFSET
    for row in np.flatnonzero((gap[:-1] > 0) & (gap[1:] <= 0)).tolist():
        part = gap[row] / (gap[row] - gap[row + 1])
        there = apart[row] + part * (apart[row + 1] - apart[row])
        normal = normals[row] + part * (normals[row + 1] - normals[row])
        if np.linalg.norm(there - (there @ normal) * normal) <= PADDLE_RADIUS:
            return float(row + part)
    return None


def struck(ball: Ball, spin: Array, paddle: ToolPose) -> tuple[Ball, Array]:
    """The ball and its spin (3,) [rad/s] just after a rigid impact on the paddle's face."""
    velocity, spin = bounce(
        np.array(ball[3:]),
        spin,
        paddle.normal,
        paddle.velocity + np.cross(paddle.spin, np.array(ball[:3]) - BALL_RADIUS * paddle.normal - paddle.position),
        restitution=PADDLE_RESTITUTION,
        friction=PADDLE_FRICTION,
        radius=BALL_RADIUS,
    )
    return Ball(ball.x, ball.y, ball.z, *velocity.tolist()), spin
