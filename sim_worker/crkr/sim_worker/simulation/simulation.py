"""MuJoCo, wrapped: a scene of an arm and a ball, whole motions in one call, body poses and shapes for drawing."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from posixpath import normpath
from typing import Any, Final, NamedTuple, final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Gains
from crkr.sim_worker.simulation.engine import Rollout, mujoco
from crkr.sim_worker.skill import Geom

__all__ = ["BallAlone", "Diverged", "Recording", "Simulation", "check_sound", "load_spec", "rotated", "scene_xml"]

PACKAGE: Final = "crkr.sim_worker"
JOINTS = 6
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


class Diverged(Exception):
    """The simulator warned or its numbers are not finite: nothing was measured."""


class Recording(NamedTuple):
    """A simulated stretch of time, n steps after the start.

    Attributes:
        states: (n + 1, 26) full physics states.
        touching: (n,) whether the ball is in contact with the tool within each step.
    """

    states: Array
    touching: NDArray[np.bool_]


@final
class Simulation:
    """A scene under MuJoCo. One object serves one thread; runs share nothing: same input, same bits.

    Args:
        spec: The scene, as `load_spec` gives it.
        touch: Name of its sensor of contact between ball and tool.
    """

    def __init__(self, spec: Any, touch: str) -> None:
        self.model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self.model)
        self._rollout = Rollout(nthread=0)
        self._warmstart = np.zeros((1, self.model.nv))
        self._touch = slice(*(self.model.sensor(touch).adr[0] + np.array([0, self.model.sensor(touch).dim[0]])))
        self.gains = Gains.of(self.model)
        self.timestep = float(self.model.opt.timestep)
        self._moving = [
            index
            for index in range(self.model.nbody)
            if self.model.body(index).name == "ball" or self.model.body_weldid[index] != 0
        ]
        self.bodies = tuple(str(self.model.body(index).name) for index in self._moving)

    def start(self, joints: Array, ball: Array) -> Array:
        """Full physics state (26,): arm at rest at `joints` (6,), ball (6,) without spin."""
        state = np.zeros(26)
        state[ARM_POSITION] = joints
        state[BALL_POSITION], state[BALL_VELOCITY] = ball[:3], ball[3:]
        state[BALL_ROTATION] = (1.0, 0.0, 0.0, 0.0)
        return state

    def start_held(self, joints: Array, site: str) -> Array:
        """Full physics state (26,): arm at rest at `joints` (6,), the ball at rest in a site of its tool."""
        model, data = self.model, self._data
        mujoco.mj_resetData(model, data)
        data.qpos[:JOINTS] = joints
        mujoco.mj_kinematics(model, data)
        state = self.start(joints, np.concatenate([data.site(site).xpos, np.zeros(3)]))
        state[BALL_ROTATION] = data.xquat[model.site(site).bodyid[0]]
        return state

    def place(self, body: str, position: Array) -> None:
        """Moves a mocap body of the scene to `position` (3,) [m]."""
        place(self.model, self._data, body, position)

    def activate(self, constraint: str, *, on: bool) -> None:
        """Switches an equality constraint of the scene on or off for later runs."""
        self.model.eq_active0[self.model.equality(constraint).id] = on

    def run(self, start: Array, controls: Array) -> Recording:
        """Simulates n steps.

        Args:
            start: (26,) full physics state.
            controls: (n, u) of the scene's u actuators; see actuators.xml for the arm's six [N m].

        Raises:
            Diverged: MuJoCo warned, or the result is not finite.
        """
        mujoco.mj_resetData(self.model, self._data)
        states, sensed = self._rollout.rollout(
            self.model, self._data, start[None], controls[None], initial_warmstart=self._warmstart
        )
        check_sound(self._data, states[0, -1])
        return Recording(np.concatenate([start[None], states[0]]), (sensed[0, :, self._touch] > 0).any(axis=1))

    def poses(self, joints: Array, balls: Array) -> tuple[Array, Array]:
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


@final
class BallAlone:
    """The same physics without the arm.

    Args:
        spec: The scene, as `load_spec` gives it; its ball and its obstacles are kept.
    """

    def __init__(self, spec: Any) -> None:
        mount = spec.body("mount")
        arm = {shape.name for shape in mount.find_all(mujoco.mjtObj.mjOBJ_GEOM)}
        pairs = [pair for pair in spec.pairs if {pair.geomname1, pair.geomname2} & arm]
        for unused in [*spec.actuators, *spec.sensors, *pairs, mount]:
            spec.delete(unused)
        self.model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self.model)
        self._rollout = Rollout(nthread=0)
        self.timestep = float(self.model.opt.timestep)

    def place(self, body: str, position: Array) -> None:
        """Moves a mocap body of the scene to `position` (3,) [m]."""
        place(self.model, self._data, body, position)

    def path(self, ball: Array, duration: float, spin: Array | None = None) -> Array:
        """Position [m], velocity [m/s] and spin [rad/s] (n + 1, 9), scene's frame, every timestep from `ball` (6,) on.

        It starts with `spin` (3,), none if None.
        """
        mujoco.mj_resetData(self.model, self._data)
        start = np.concatenate([[0.0], ball[:3], [1.0, 0.0, 0.0, 0.0], ball[3:], np.zeros(3) if spin is None else spin])
        steps = int(np.ceil(duration / self.timestep))
        states, _ = self._rollout.rollout(self.model, self._data, start[None], nstep=steps)
        full = np.concatenate([start[None], states[0]])
        turning = rotated(full[:, 4:8], full[:, 11:14])  # MuJoCo's is in the ball's frame
        return np.concatenate([full[:, 1:4], full[:, 8:11], turning], axis=1)


def place(model: Any, data: Any, body: str, position: Array) -> None:
    """Moves a mocap body [m], in the model and in the current data."""
    model.body(body).pos = position
    data.mocap_pos[model.body(body).mocapid[0]] = position


def check_sound(data: Any, last: Array) -> None:
    """Raises `Diverged` if MuJoCo warned or its last state is not finite."""
    if data.warning.number.any() or not np.isfinite(last).all():
        raised = [mujoco.mjtWarning(i).name for i in np.flatnonzero(data.warning.number)]
        raise Diverged(f"the simulation broke down: {', '.join(raised) or 'not finite'}")


def load_spec(folder: str) -> Any:
    """The scene in a folder of this package, as an editable MuJoCo specification."""
    return mujoco.MjSpec.from_string(scene_xml(folder))


def scene_xml(folder: str) -> str:
    """The text of `scene.xml` in a folder of this package, e.g. "table_tennis", with its includes written out.

    Paths of includes are relative to that folder, as in MuJoCo; Pinocchio would ignore includes.
    """
    root = files(PACKAGE)
    return ET.tostring(_complete(root, folder, "scene.xml"), encoding="unicode")


def _complete(root: Traversable, folder: str, name: str) -> ET.Element:
    text = root.joinpath(*normpath(f"{folder}/{name}").split("/")).read_text(encoding="utf-8")
    element = ET.fromstring(text)
    for parent in list(element.iter()):
        for place, child in reversed(list(enumerate(parent))):
            if child.tag == "include":
                parent[place : place + 1] = list(_complete(root, folder, child.attrib["file"]))
    return element


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def rotated(quaternions: Array, vectors: Array) -> Array:
    """`vectors` (n, 3) rotated by unit quaternions (n, 4), scalar first."""
    scalar, axis = quaternions[:, :1], quaternions[:, 1:]
    twice = 2 * np.cross(axis, vectors)
    return np.asarray(vectors + scalar * twice + np.cross(axis, twice))
