"""No simulator: the arm follows its swing perfectly, the ball flies and bounces by formulas."""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.table_tennis.arm.dynamics import Arm
from crkr.sim_worker.table_tennis.ball.incoming import Incoming
from crkr.sim_worker.table_tennis.ball.strike import FaceMotion, played
from crkr.sim_worker.table_tennis.environments.play import FOLLOW, Play

__all__ = ["AnalyticEnvironment"]

Floats = NDArray[np.float64]

INTERVAL: Final = 0.004  # between looks at the paddle [s]


@final
class AnalyticEnvironment:
    """Executes swings by formulas alone.

    Args:
        arm: Kinematics.
        magnus: Whether a spinning ball is lifted.
    """

    def __init__(self, arm: Arm, *, magnus: bool = False) -> None:
        self._arm = arm
        self._magnus = magnus

    def play(self, ball: Floats, swing: JointTrajectory, hit_time: float) -> Play:
        """Executes `swing` against the ball measured as `ball` (6,) at time 0.

        Raises:
            Diverged: That is no ball's state.
        """
        times = np.arange(int(np.ceil((hit_time + FOLLOW) / INTERVAL)) + 1, dtype=np.float64) * INTERVAL
        joints, speeds, _ = swing.sample(times)
        faces = [self._arm.paddle(row) for row in joints]
        centres, normals = np.array([face.position for face in faces]), np.array([face.normal for face in faces])
        incoming = Incoming(ball, float(times[-1]), magnus=self._magnus)
        return played(self._arm, incoming, FaceMotion(times, joints, speeds, centres, normals), hit_time)
