"""The environments by name, and the two that need no contact simulation.

Whatever the environment, a swing against a ball gives one `Play`:

* "contact": arm, ball, table and paddle in MuJoCo (`contact`);
* "hybrid": the arm in MuJoCo, the ball by exact formulas, rigid impacts;
* "analytic": no simulator; the arm follows its swing perfectly.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm, tracking_controls
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.table_tennis.ball.incoming import FreeBall, Incoming
from crkr.sim_worker.table_tennis.ball.strike import FaceMotion, played
from crkr.sim_worker.table_tennis.environments.contact import ContactEnvironment
from crkr.sim_worker.table_tennis.environments.play import FOLLOW, Environment, Play
from crkr.sim_worker.table_tennis.planner import Predictor
from crkr.sim_worker.table_tennis.scene import ArmAlone, make_ball_alone

__all__ = ["ENVIRONMENTS", "AnalyticEnvironment", "HybridEnvironment", "make_environment", "make_predictor"]

ENVIRONMENTS: Final = ("contact", "hybrid", "analytic")
INTERVAL: Final = 0.004  # between two paddle poses of the analytic environment [s]


@final
class HybridEnvironment:
    """Executes swings with a simulated arm and an event-driven ball; the ball does not push the arm back."""

    def __init__(self, arm: Arm, alone: ArmAlone, *, magnus: bool = False) -> None:
        self._arm = arm
        self._alone = alone
        self._magnus = magnus

    def play(self, ball: Array, swing: JointTrajectory, hit_time: float) -> Play:
        """Executes `swing` against the ball measured as `ball` (6,) at time 0.

        Raises:
            Diverged: The simulator failed, or `ball` is not a ball's state.
        """
        step = self._alone.timestep
        times = np.arange(int(np.ceil((hit_time + FOLLOW) / step)) + 1, dtype=np.float64) * step
        controls = tracking_controls(self._arm, self._alone.gains, swing, times[:-1])
        record = self._alone.run(swing.position[0], controls)
        face = FaceMotion(times, record.joints, record.speeds, record.centres, record.normals)
        return played(self._arm, Incoming(ball, float(times[-1]), magnus=self._magnus), face, hit_time)


@final
class AnalyticEnvironment:
    """Executes swings by formulas alone."""

    def __init__(self, arm: Arm, *, magnus: bool = False) -> None:
        self._arm = arm
        self._magnus = magnus

    def play(self, ball: Array, swing: JointTrajectory, hit_time: float) -> Play:
        """Executes `swing` against the ball measured as `ball` (6,) at time 0.

        Raises:
            Diverged: `ball` is not a ball's state.
        """
        times = np.arange(int(np.ceil((hit_time + FOLLOW) / INTERVAL)) + 1, dtype=np.float64) * INTERVAL
        joints, speeds, _ = swing.sample(times)
        faces = [self._arm.tool(row) for row in joints]
        centres, normals = np.array([face.position for face in faces]), np.array([face.normal for face in faces])
        incoming = Incoming(ball, float(times[-1]), magnus=self._magnus)
        return played(self._arm, incoming, FaceMotion(times, joints, speeds, centres, normals), hit_time)


def make_environment(name: str, arm: Arm, simulation: Simulation, *, magnus: bool = False) -> Environment:
    """The environment of that name, one of `ENVIRONMENTS`, with lift where `magnus` says so, of `simulation` too."""
    if name == "contact":
        return ContactEnvironment(arm, simulation, magnus=magnus)
    if name == "hybrid":
        return HybridEnvironment(arm, ArmAlone(), magnus=magnus)
    return AnalyticEnvironment(arm, magnus=magnus)


def make_predictor(name: str, *, magnus: bool = False) -> Predictor:
    """Predicts a ball that is not hit, in the environment of that name."""
    return make_ball_alone(magnus=magnus) if name == "contact" else FreeBall(magnus=magnus)
