"""A trial as displays show it: body poses and the ball's path at about film rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Trace
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.table_tennis.environments.play import Play
from crkr.sim_worker.table_tennis.tracker import Verdict, rally

__all__ = ["Motion", "motion", "trace"]

Floats = NDArray[np.float64]

INTERVAL = 1 / 30  # [s]


@final
@dataclass(frozen=True, slots=True)
class Motion:
    """A trial in generalised coordinates.

    Attributes:
        time: (n,) [s] from the snapshot.
        joints: (n, 6) joint positions [rad].
        ball: (n, 3) ball positions [m].
        hit_time: When the goal asked for the hit [s].
    """

    time: Floats
    joints: Floats
    ball: Floats
    hit_time: float


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
    joints, ball = _at(time, play.time, play.joints), _at(time, play.time, play.path)
    if verdict.landing is not None:
        later, flight = rally(play.after, verdict.landing[0], interval, play.curl)
        time = np.concatenate([time, play.end + later])
        joints = np.concatenate([joints, swing.sample(play.end + later)[0]])
        ball = np.concatenate([ball, flight])
    return Motion(time, joints, ball, play.hit_time)


def trace(simulation: Simulation, moved: Motion) -> Trace:
    """The poses of the scene's bodies in a motion."""
    positions, quaternions = simulation.poses(moved.joints, moved.ball)
    return Trace(moved.time, simulation.bodies, positions, quaternions, {"ball": moved.ball})


def _at(time: Floats, known: Floats, values: Floats) -> Floats:
    """`values` (n, k) linearly interpolated at `time` (m,)."""
    after = np.clip(np.searchsorted(known, time, side="right"), 1, len(known) - 1)
    part = (time - known[after - 1]) / (known[after] - known[after - 1])
    return np.asarray(values[after - 1] + part[:, None] * (values[after] - values[after - 1]))
