"""The arm by simulation, the ball by exact formulas: the paddle moves as it really would, impacts are rigid."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.table_tennis.arm import tracking
from crkr.sim_worker.table_tennis.arm.dynamics import Arm
from crkr.sim_worker.table_tennis.ball.incoming import Incoming
from crkr.sim_worker.table_tennis.ball.strike import FaceMotion, played
from crkr.sim_worker.table_tennis.environments.partial_scenes import ArmAlone
from crkr.sim_worker.table_tennis.environments.play import FOLLOW, Play

__all__ = ["HybridEnvironment"]

Floats = NDArray[np.float64]


@final
class HybridEnvironment:
    """Executes swings with a simulated arm and an event-driven ball; the ball does not push the arm back.

    Args:
        arm: Kinematics and dynamics.
        alone: The simulated arm.
        magnus: Whether a spinning ball is lifted.
    """

    def __init__(self, arm: Arm, alone: ArmAlone, *, magnus: bool = False) -> None:
        self._arm = arm
        self._alone = alone
        self._magnus = magnus

    def play(self, ball: Floats, swing: JointTrajectory, hit_time: float) -> Play:
        """Executes `swing` against the ball measured as `ball` (6,) at time 0.

        Raises:
            Diverged: The simulator broke down, or that is no ball's state.
        """
        step = self._alone.timestep
        times = np.arange(int(np.ceil((hit_time + FOLLOW) / step)) + 1, dtype=np.float64) * step
        controls = tracking.controls(self._arm, self._alone.gains, swing, times[:-1])
        record = self._alone.run(swing.position[0], controls)
        face = FaceMotion(times, record.joints, record.speeds, record.centres, record.normals)
        return played(self._arm, Incoming(ball, float(times[-1]), magnus=self._magnus), face, hit_time)
