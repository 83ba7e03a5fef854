"""The arm simulated alone, without the ball."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.tracking import Gains
from crkr.sim_worker.simulation.engine import Rollout, mujoco
from crkr.sim_worker.simulation.simulation import check_sound
from crkr.sim_worker.table_tennis.scene import load_scene

__all__ = ["ArmAlone", "ArmRecording"]


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
        # A sensor tells the pose that a step started from, so one step more than asked for.
        extended = np.concatenate([controls, controls[-1:]])
        states, sensed = self._rollout.rollout(
            self._model, self._data, start[None], extended[None], initial_warmstart=self._warmstart
        )
        check_sound(self._data, states[0, -1])
        full = np.concatenate([start[None], states[0, :-1]])
        return ArmRecording(full[:, 1:7], full[:, 7:13], sensed[0, :, :3], sensed[0, :, 3:6])
