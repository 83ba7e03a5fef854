"""A trial's motion in an arm's scene, and the trace that displays show of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.protocol import Array, Trace
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.simulation.simulation import Simulation

__all__ = ["INTERVAL", "Motion", "interpolated", "trace"]

INTERVAL: Final = 1 / 30  # between two rows, about film rate [s]


@final
@dataclass(frozen=True, slots=True)
class Motion:
    """A trial in generalised coordinates.

    Attributes:
        time: (n,) [s] from the start.
        joints: (n, 6) joint positions [rad].
        ball: (n, 3) ball positions [m].
    """

    time: Array
    joints: Array
    ball: Array

    def continued(self, swing: JointTrajectory, flight: tuple[Array, Array], end: float) -> Motion:
        """This motion until `end` [s]; from then on the arm follows its swing, and the ball its `flight`.

        Args:
            swing: The planned motion of the arm.
            flight: Times (m,) [s] after `end`, and the ball's positions (m, 3) [m].
            end: When the flight begins [s].
        """
        later, path = flight
        kept = self.time < end
        return Motion(
            np.concatenate([self.time[kept], end + later]),
            np.concatenate([self.joints[kept], swing.sample(end + later)[0]]),
            np.concatenate([self.ball[kept], path]),
        )

    def resampled(self, interval: float) -> Motion:
        """The same from time 0 on, in rows `interval` [s] apart, and its end, linearly interpolated."""
        time = np.append(np.arange(0.0, self.time[-1], interval), self.time[-1])
        return Motion(time, interpolated(time, self.time, self.joints), interpolated(time, self.time, self.ball))


def trace(simulation: Simulation, moved: Motion) -> Trace:
    """The poses of the scene's bodies in a motion."""
    positions, quaternions = simulation.poses(moved.joints, moved.ball)
    return Trace(moved.time, simulation.bodies, positions, quaternions, {"ball": moved.ball})


def interpolated(time: Array, known: Array, values: Array) -> Array:
    """`values` (n, k) linearly interpolated at `time` (m,)."""
    after = np.clip(np.searchsorted(known, time, side="right"), 1, len(known) - 1)
    part = (time - known[after - 1]) / (known[after] - known[after - 1])
    return np.asarray(values[after - 1] + part[:, None] * (values[after] - values[after - 1]))
