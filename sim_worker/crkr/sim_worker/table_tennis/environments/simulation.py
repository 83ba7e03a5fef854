"""MuJoCo, wrapped: the scene, whole swings in one call, body poses and shapes for drawing."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib.resources import as_file, files
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.skill import Geom
from crkr.sim_worker.table_tennis.arm.tracking import Gains
from crkr.sim_worker.table_tennis.ball.constants import BALL_MASS, BALL_RADIUS, MAGNUS
from crkr.sim_worker.table_tennis.environments.engine import Rollout, mujoco
from crkr.sim_worker.table_tennis.environments.play import Diverged

__all__ = ["Recording", "Simulation", "load_spec", "rotated"]

Floats = NDArray[np.float64]

JOINTS = 6
AIR_DENSITY = 1.2  # [kg/m^3], as in scene.xml
BALL_VOLUME = 4 / 3 * np.pi * BALL_RADIUS**3  # [m^3]
# A full physics state: time, arm and ball positions (6, then 3 + quaternion), arm and ball velocities (6, then 3 + 3).
ARM_POSITION, BALL_POSITION, BALL_ROTATION = slice(1, 7), slice(7, 10), slice(10, 14)
ARM_VELOCITY, BALL_VELOCITY, BALL_SPIN = slice(14, 20), slice(20, 23), slice(23, 26)
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
}


_log = logging.getLogger(__name__)


def _to_log(message: str) -> None:
    _log.debug("MuJoCo: %s", message)


# Unless told otherwise, MuJoCo writes its warnings to a file in the working directory; `Diverged` carries them instead.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_to_log)


class Recording(NamedTuple):
    """A simulated stretch of time, n steps after the start.

    Attributes:
        states: (n + 1, 26) full physics states.
        touching: (n,) whether the ball is in contact with the paddle within each step.
    """

    states: Floats
    touching: NDArray[np.bool_]


@final
class Simulation:
    """The scene under MuJoCo. One object serves one thread; runs share nothing: same input, same bits.

    Args:
        magnus: Whether a spinning ball is lifted.
    """

    def __init__(self, *, magnus: bool = False) -> None:
        self.model: Any = load_spec(magnus=magnus).compile()
        self.magnus = magnus
        self._data: Any = mujoco.MjData(self.model)
        self._rollout = Rollout(nthread=0)
        self._warmstart = np.zeros((1, self.model.nv))
        touch = self.model.sensor("touch_paddle")
        self._touch = int(touch.adr[0])
        self.gains = Gains.of(self.model)
        self.timestep = float(self.model.opt.timestep)
        self._moving = [
            index
            for index in range(self.model.nbody)
            if self.model.body(index).name == "ball" or self.model.body_weldid[index] != 0
        ]
        self.bodies = tuple(str(self.model.body(index).name) for index in self._moving)

    def start(self, joints: Floats, ball: Floats) -> Floats:
        """Full physics state (26,): arm at rest at `joints` (6,), ball (6,) without spin."""
        state = np.zeros(26)
        state[ARM_POSITION] = joints
        state[BALL_POSITION], state[BALL_VELOCITY] = ball[:3], ball[3:]
        state[BALL_ROTATION] = (1.0, 0.0, 0.0, 0.0)
        return state

    def run(self, start: Floats, controls: Floats) -> Recording:
        """Simulates n steps.

        Args:
            start: (26,) full physics state.
            controls: (n, 6) generalised controls, see scene.xml [N m].

        Raises:
            Diverged: MuJoCo warned, or the result is not finite.
        """
        mujoco.mj_resetData(self.model, self._data)
        states, sensed = self._rollout.rollout(
            self.model, self._data, start[None], controls[None], initial_warmstart=self._warmstart
        )
        check_sound(self._data, states[0, -1])
        return Recording(np.concatenate([start[None], states[0]]), sensed[0, :, self._touch] > 0)

    def poses(self, joints: Floats, balls: Floats) -> tuple[Floats, Floats]:
        """Positions (m, b, 3) and scalar-last rotations (m, b, 4) of `bodies`, for joints (m, 6) and balls (m, 3)."""
        model, data = self.model, self._data
        positions = np.empty((len(joints), len(self._moving), 3))
        rotations = np.empty((len(joints), len(self._moving), 4))
        data.qpos[9:13] = (1.0, 0.0, 0.0, 0.0)
        for row, (arm, ball) in enumerate(zip(joints, balls, strict=True)):
            data.qpos[:JOINTS], data.qpos[JOINTS : JOINTS + 3] = arm, ball
            mujoco.mj_kinematics(model, data)
            positions[row], rotations[row] = data.xpos[self._moving], data.xquat[self._moving]
        return positions, np.roll(rotations, -1, axis=2)

    def geoms(self) -> Sequence[Geom]:
        """Boxes, spheres, capsules and cylinders of the scene; the floor, a plane, becomes a flat box."""
        return [self._geom(index) for index in range(self.model.ngeom)]

    def _geom(self, index: int) -> Geom:
        model = self.model
        kind, size = int(model.geom_type[index]), np.array(model.geom_size[index])
        position = np.array(model.geom_pos[index])
        if kind == int(mujoco.mjtGeom.mjGEOM_PLANE):
            kind, size, position = (
                int(mujoco.mjtGeom.mjGEOM_BOX),
                np.array([*size[:2], 0.005]),
                position - [0, 0, 0.005],
            )
        body = int(model.geom_bodyid[index])
        fixed = int(model.body_weldid[body]) == 0
        rotation = np.array(model.geom_quat[index])
        if fixed:  # Bodies that never move are drawn in the world.
            mujoco.mj_resetData(model, self._data)
            mujoco.mj_kinematics(model, self._data)
            offset = np.array(self._data.xpos[body])
            position = position + offset
        return Geom(
            body="world" if fixed else str(model.body(body).name),
            shape=SHAPES[kind],
            size=_triple(size),
            position=_triple(position),
            quaternion=(float(rotation[1]), float(rotation[2]), float(rotation[3]), float(rotation[0])),
            colour=tuple(float(c) for c in model.geom_rgba[index]),  # type: ignore[arg-type]  # four of them
        )


def check_sound(data: Any, last: Floats) -> None:
    """Raises `Diverged` if MuJoCo warned or its last state is not finite."""
    if data.warning.number.any() or not np.isfinite(last).all():
        raised = [mujoco.mjtWarning(i).name for i in np.flatnonzero(data.warning.number)]
        raise Diverged(f"the simulation broke down: {', '.join(raised) or 'not finite'}")


def load_spec(*, magnus: bool = False) -> Any:
    """The scene as an editable MuJoCo specification."""
    with as_file(files("crkr.sim_worker.table_tennis") / "scene.xml") as path:
        spec = mujoco.MjSpec.from_file(str(path))
    if magnus:  # The last coefficient is relative to density * volume * spin x velocity.
        spec.geom("ball").fluid_coefs[4] += MAGNUS * BALL_MASS / (AIR_DENSITY * BALL_VOLUME)
    return spec


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def rotated(quaternions: Floats, vectors: Floats) -> Floats:
    """`vectors` (n, 3) rotated by unit quaternions (n, 4), scalar first."""
    scalar, axis = quaternions[:, :1], quaternions[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return np.asarray(vectors + scalar * twice + np.cross(axis, twice))
