"""How a goal becomes the actions of an episode: at once, by via-points of the actions, or by a stroke of the joints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol, final

import numpy as np
from scipy.interpolate import PchipInterpolator

from crkr.protocol import Array, Invalid
from crkr.protocol.errors import shown
from crkr.sim_worker.gymnasium.environment import Bounds, Environment, narrowed
from crkr.sim_worker.primitives import JointLimits, Primitive

__all__ = ["Actions", "JointStroke", "Motion", "ViaPoints", "motion_for"]

Actions = Callable[[int], Array]
"""The action (n,) of a step."""

HIT: Final = 0.6  # share of the episode until the joints arrive
STIFFNESS: Final = 0.3  # per step: feedback gain; beyond 0.5 it oscillates
MOST_POINTS: Final = 256  # a goal has no more numbers
MARGIN: Final = 0.02  # share of a joint's range at each end that goals avoid


class Motion(Protocol):
    """Turns a goal into an episode's actions."""

    @property
    def axes(self) -> list[dict[str, Any]]:
        """The specification's `goal`."""

    def begin(self, goal: Array) -> Actions:
        """Plans from the environment's current state; raises `Infeasible` for a goal that cannot be tried."""


def motion_for(environment: Environment, via_points: int | None, goal_bounds: Bounds | None = None) -> Motion:
    """The motion that suits an environment.

    A stroke of the joints where the environment is a MuJoCo model whose actions drive joints one by one and
    `via_points` is None; otherwise actions through that many points, one unless given. Raises `Invalid` for bounds that
    leave goals no room, and for no or too many points.
    """
    if via_points is not None and not (isinstance(via_points, int) and 1 <= via_points <= MOST_POINTS):
        raise Invalid(f"via_points must be a whole number from 1 to {MOST_POINTS}; got {shown(via_points)}")
    if environment.steps > 1 and via_points is None and _drives_joints(environment):
        return JointStroke(environment, goal_bounds)
    return ViaPoints(environment, 1 if environment.steps == 1 else via_points or 1, goal_bounds)


@final
class ViaPoints:
    """Actions through points equally spaced in time, monotone between them and so within the bounds.

    Args:
        environment: Whose actions.
        count: Points for each number of an action; one point is a constant action.
        goal_bounds: Narrower ones than the environment's.
    """

    def __init__(self, environment: Environment, count: int, goal_bounds: Bounds | None = None) -> None:
        self._steps = environment.steps
        self._count = count
        self._low, self._high = narrowed(environment.low, environment.high, goal_bounds, environment.name)

    @property
    def axes(self) -> list[dict[str, Any]]:
        """One goal for each point and number of an action."""
        box = list(enumerate(zip(self._low.tolist(), self._high.tolist(), strict=True)))
        return [
            {"name": f"action_{index}" + (f"_at_{point}" if self._count > 1 else ""), "low": low, "high": high}
            for point in range(self._count)
            for index, (low, high) in box
        ]

    def begin(self, goal: Array) -> Actions:
        """The actions that pass the points."""
        points = goal.reshape(self._count, -1)
        if self._count == 1:
            return lambda _: points[0]
        path = PchipInterpolator(np.linspace(0, self._steps - 1, self._count), points)(np.arange(self._steps))
        return lambda step: np.asarray(path[step], dtype=np.float64)


@final
class JointStroke:
    """A stroke from the current to the goal's joint positions, planned by `Primitive`'s quadratic program.

    Motors follow it by computed torque: the model's inertia, gravity and friction, and feedback. Servos get its
    positions.

    Args:
        environment: A MuJoCo model whose actions are its controls.
        goal_bounds: Narrower ones than the joints' limits.
    """

    def __init__(self, environment: Environment, goal_bounds: Bounds | None = None) -> None:
        self._steps = environment.steps
        simulation: Any = environment.env.unwrapped
        self._model, self._data, self._dt = simulation.model, simulation.data, float(simulation.dt)
        model = self._model
        joint = model.actuator_trnid[:, 0]
        self._position, self._dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        self._gear = model.actuator_gear[:, 0].copy()
        self._servo = bool((model.actuator_biasprm[:, 1] != 0).all())
        self._names = [model.joint(int(index)).name or f"joint_{index}" for index in joint]
        limited = model.jnt_limited[joint].astype(bool)
        self._lower = np.where(limited, model.jnt_range[joint, 0], -np.pi)
        self._upper = np.where(limited, model.jnt_range[joint, 1], np.pi)
        self._hit = HIT * environment.steps * self._dt
        width = self._upper - self._lower
        inside = self._lower + MARGIN * width, self._upper - MARGIN * width
        self._box = narrowed(*inside, goal_bounds, environment.name)
        self._primitive = Primitive(
            JointLimits(self._lower, self._upper, 4 * width / self._hit, 16 * width / self._hit**2)
        )

    @property
    def axes(self) -> list[dict[str, Any]]:
        """One goal for each joint that is driven."""
        ends = zip(self._names, self._box[0].tolist(), self._box[1].tolist(), strict=True)
        return [{"name": name, "unit": "rad", "low": low, "high": high} for name, low, high in ends]

    def begin(self, goal: Array) -> Actions:
        """Plans the stroke from the joints' present positions."""
        start = np.clip(self._data.qpos[self._position], self._lower, self._upper)
        times = self._dt * np.arange(1, self._steps + 1)
        still = np.zeros_like(start)
        stroke = self._primitive.trajectory(start, goal, still, self._hit)
        position, velocity, acceleration = stroke.sample(np.minimum(times, self._hit))
        acceleration[times >= self._hit] = 0.0  # it stays where it arrived
        if self._servo:
            return lambda step: position[step]
        return lambda step: self._torque(position[step], velocity[step], acceleration[step]) / self._gear

    def _torque(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Computed torque (n,) towards the next step's position and velocity."""
        import mujoco

        model, data, dof = self._model, self._data, self._dof
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        rate = STIFFNESS / self._dt
        behind = position - data.qpos[self._position]
        wanted = acceleration + 2 * rate * (velocity - data.qvel[dof]) + rate**2 * behind
        resisting = (data.qfrc_bias - data.qfrc_passive)[dof]
        return np.asarray(inertia[np.ix_(dof, dof)] @ wanted + resisting, dtype=np.float64)


def _drives_joints(environment: Environment) -> bool:
    """Whether each action is the control of an actuator, and each actuator a motor or a servo of a joint of its own."""
    simulation: Any = environment.env.unwrapped
    model: Any = getattr(simulation, "model", None)
    if not all(hasattr(model, name) for name in ("actuator_trntype", "actuator_ctrlrange")):
        return False
    import mujoco

    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    joints = model.actuator_trnid[:, 0]
    servo = model.actuator_biasprm[:, 1] != 0
    return bool(
        hasattr(simulation, "dt")
        and model.nu == environment.low.size > 0
        and np.allclose(model.actuator_ctrlrange, np.column_stack([environment.low, environment.high]))
        and (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)).all()
        and np.isin(model.jnt_type[joints], (hinge, slide)).all()
        and len(set(joints.tolist())) == model.nu
        and (servo.all() or not servo.any())
    )
