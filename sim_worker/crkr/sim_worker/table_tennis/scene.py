"""The scene of table tennis, for the simulator, for kinematics, and for collisions."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.collision import CollisionCheck, own_pairs
from crkr.sim_worker.arm.dynamics import Arm, Gains
from crkr.sim_worker.simulation.engine import Rollout, mujoco
from crkr.sim_worker.simulation.simulation import BallAlone, Simulation, check_sound, load_spec, scene_xml
from crkr.sim_worker.table_tennis.ball.constants import BALL_MASS, BALL_RADIUS, MAGNUS

__all__ = ["ArmAlone", "ArmRecording", "load_scene", "make_arm", "make_ball_alone", "make_check", "make_simulation"]

FOLDER: Final = "table_tennis"
TOOL: Final = ("handle", "paddle")
# The net is more than 10 cm out of the stretched arm's reach. Upper arm and shoulder never come near the table before
# the forearm.
NEAR: Final = tuple((part, "table") for part in ("elbow", "forearm", "wrist_1", "wrist_2", "wrist_3", *TOOL))
AIR_DENSITY: Final = 1.2  # [kg/m^3], as in common.xml
BALL_VOLUME: Final = 4 / 3 * np.pi * BALL_RADIUS**3  # [m^3]


def load_scene(*, magnus: bool = False) -> Any:
    """The scene as an editable MuJoCo specification; with `magnus` a spinning ball is lifted."""
    spec = load_spec(FOLDER)
    if magnus:  # The last coefficient is relative to density * volume * spin x velocity.
        spec.geom("ball").fluid_coefs[4] += MAGNUS * BALL_MASS / (AIR_DENSITY * BALL_VOLUME)
    return spec


def make_arm() -> Arm:
    """The arm with its paddle."""
    return Arm(scene_xml(FOLDER), "paddle")


def make_simulation(*, magnus: bool = False) -> Simulation:
    """The whole scene, simulated."""
    return Simulation(load_scene(magnus=magnus), "touch_paddle")


def make_ball_alone(*, magnus: bool = False) -> BallAlone:
    """The scene without the arm, simulated."""
    return BallAlone(load_scene(magnus=magnus))


def make_check(arm: Arm, *, itself: bool = False) -> CollisionCheck:
    """Checks the arm against the table, and, for contact alone, against itself and its pedestal."""
    return CollisionCheck(arm, NEAR, own_pairs(*TOOL) if itself else ())


class ArmRecording(NamedTuple):
    """A simulated swing without a ball, n steps after the start.

    Attributes:
        joints: (n + 1, 6) positions [rad].
        speeds: (n + 1, 6) [rad/s].
        centres: (n + 1, 3) of the paddle [m].
        normals: (n + 1, 3) of its front face.
    """

    joints: Array
    speeds: Array
    centres: Array
    normals: Array


@final
class ArmAlone:
    """The arm without ball and contacts, at a coarser time step than contacts need."""

    timestep: Final = 0.0025  # [s]

    def __init__(self) -> None:
        spec = load_scene()
        for unused in [*spec.sensors, *spec.pairs, spec.body("ball")]:
            spec.delete(unused)
        site, face = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtSensor
        spec.add_sensor(name="centre", type=face.mjSENS_FRAMEPOS, objtype=site, objname="paddle")
        spec.add_sensor(name="normal", type=face.mjSENS_FRAMEXAXIS, objtype=site, objname="paddle")
        spec.option.timestep = self.timestep
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        self._rollout = Rollout(nthread=0)
        self._warmstart = np.zeros((1, self._model.nv))
        self.gains = Gains.of(self._model)

    def run(self, joints: Array, controls: Array) -> ArmRecording:
        """Simulates n steps from rest at `joints` (6,) under `controls` (n, 6) [N m].

        The pose of the paddle in a row is that of the joints in the same row.

        Raises:
            Diverged: MuJoCo warned, or the result is not finite.
        """
        mujoco.mj_resetData(self._model, self._data)
        start = np.concatenate([[0.0], joints, np.zeros(6)])
        # A sensor shows the pose at the start of a step, so one more step is needed.
        extended = np.concatenate([controls, controls[-1:]])
        states, sensed = self._rollout.rollout(
            self._model, self._data, start[None], extended[None], initial_warmstart=self._warmstart
        )
        check_sound(self._data, states[0, -1])
        full = np.concatenate([start[None], states[0, :-1]])
        return ArmRecording(full[:, 1:7], full[:, 7:13], sensed[0, :, :3], sensed[0, :, 3:6])
