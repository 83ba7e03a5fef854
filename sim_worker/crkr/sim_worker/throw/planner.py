"""A planner for demonstrations and the oracle: how to throw a ball so that it passes over the wall into the bin."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import SPEED_LIMITS, Arm
from crkr.sim_worker.primitives.joint_motion import JointLimits, spare_time
from crkr.sim_worker.simulation.flight import GRAVITY, Ball
from crkr.sim_worker.throw.layouts import AIR, Layout
from crkr.sim_worker.throw.outcome import Passage

__all__ = ["HOME", "POSTURE", "RELEASE", "WRIST", "Planner", "full_goal"]

# Wrist 2 turns the hand into the plane of the throw and stays there, as wrist 3 does.
WRIST: Final = (-0.5 * np.pi, 0.0)
# Shoulder lift, elbow and wrist 1 at the release: the hand is over and behind the base and moves up and forward. Found
# by search for the postures whose throws ask least of the joints' speeds.
POSTURE: Final = np.array([0.24, -1.08, -1.29])
POSTURES: Final = (POSTURE, np.array([-0.26, -0.54, -1.67]), np.array([0.5, -1.14, -1.84]))
BACK: Final = np.array([0.35, 0.5, 0.3])  # how far behind the release the arm waits [rad]
HOME: Final = np.array([0.0, *(POSTURE - BACK), *WRIST])
RELEASE: Final = slice(1, 4)  # the joints that throw

DURATIONS: Final = tuple(np.arange(0.4, 1.2, 0.05).tolist())  # of the flight to the rim [s]
OVER_WALL: Final = 0.06  # [m]
SPARE: Final = 0.1  # time left over for the arm [s]
MIXTURES: Final = np.linspace(-1.5, 1.5, 61)
SOONEST: Final = 0.3  # [s]
FASTEST: Final = 0.97  # of the joints' speed limits
MOST_PLANS: Final = 10


def full_goal(goal: Array) -> tuple[Array, Array, float]:
    """Joint positions (6,) [rad] and speeds (6,) [rad/s] at the release of a goal (8,), and its time [s]."""
    still = np.zeros(1)
    return np.concatenate([goal[:4], WRIST]), np.concatenate([still, goal[4:7], still, still]), float(goal[7])


@final
class Planner:
    """Plans throws with an ideal release."""

    def __init__(self, arm: Arm, limits: JointLimits) -> None:
        self._arm = arm
        self._limits = limits

    def goals(self, layout: Layout) -> Iterator[Array]:
        """Goals (8,) that throw the ball in, best first, at most ten; whether a swing can do that is not checked."""
        found = [plan for posture in POSTURES for plan in self._plans(layout, posture)]
        found.sort(key=lambda plan: plan[0])
        yield from (goal for _, goal in found[:MOST_PLANS])

    def _plans(self, layout: Layout, posture: Array) -> Iterator[tuple[float, Array]]:
        """Each plan's greatest joint speed over its limit, and its goal (8,)."""
        aside = self._arm.tool(np.array([0.0, *posture, *WRIST])).position[1]  # of the plane in which the arm throws
        x, y = layout.bin[:2]
        pan = float(np.arctan2(y, x) - np.arcsin(aside / np.hypot(x, y)))
        joints = np.array([pan, *posture, *WRIST])
        start = self._arm.tool(joints).position
        plane = np.array([[np.cos(pan), np.sin(pan), 0.0], [0.0, 0.0, 1.0]])
        rows = plane @ self._arm.jacobian(joints)[:3, RELEASE] * SPEED_LIMITS[RELEASE]  # (2, 3)
        least = rows.T @ np.linalg.inv(rows @ rows.T)
        free = np.linalg.svd(rows)[2][-1]  # a change of the speeds that does not move the hand
        for duration in DURATIONS:
            velocity = _launch(start, layout.bin, duration)
            passage = Passage.of(Ball(*start.tolist(), *velocity.tolist()), layout)
            if not passage.clearance >= OVER_WALL:
                continue
            mixed = least @ (plane @ velocity) + MIXTURES[:, None] * free  # (61, 3)
            greatest = np.abs(mixed).max(axis=1)
            best = int(np.argmin(greatest))
            if greatest[best] <= FASTEST:
                speeds = mixed[best] * SPEED_LIMITS[RELEASE]
                yield float(greatest[best]), np.array([pan, *posture, *speeds, self._time(joints, speeds)])

    def _time(self, joints: Array, speeds: Array) -> float:
        whole = np.array([0.0, *speeds, 0.0, 0.0])
        return max(SPARE - spare_time(self._limits, joints - HOME, whole, 0.0), SOONEST)


def _launch(start: Array, target: Array, duration: float) -> Array:
    """Velocity (3,) that carries a ball from `start` to `target` (3,) in `duration` [s]."""
    velocity = (target - start) / duration + [0.0, 0.0, 0.5 * GRAVITY * duration]
    for _ in range(12):
        miss = target - np.array(AIR.flight(Ball(*start.tolist(), *velocity.tolist()), duration)[:3])
        velocity = velocity + miss / duration
        if np.abs(miss).max() < 1e-9:
            break
    return velocity
