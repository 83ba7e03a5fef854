"""The scene of the throw, and how a throw is executed in it: in contact simulation, or by formulas.

Both give a `Flight`. "contact": the arm tracks its swing in MuJoCo with the ball in its gripper, lets go between two
steps, and ball, wall, bin and floor touch. "analytic": the arm follows its swing perfectly, the ball leaves with the
gripper's velocity and flies through air; where it passes wall and bin decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.collision import CollisionCheck, own_pairs
from crkr.sim_worker.arm.dynamics import Arm, tracking_controls
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.simulation.flight import GRAVITY, STEP, Ball
from crkr.sim_worker.simulation.motion import Motion
from crkr.sim_worker.simulation.simulation import (
    ARM_POSITION,
    BALL_POSITION,
    BALL_ROTATION,
    BALL_SPIN,
    BALL_VELOCITY,
    BallAlone,
    Simulation,
    load_spec,
    rotated,
    scene_xml,
)
from crkr.sim_worker.throw.layouts import AIR, BALL_RADIUS, OPENING, RIM, Layout
from crkr.sim_worker.throw.outcome import Passage

__all__ = [
    "ENVIRONMENTS",
    "Environment",
    "Flight",
    "make_arm",
    "make_check",
    "make_environment",
    "make_simulation",
]

ENVIRONMENTS: Final = ("contact", "analytic")
FOLDER: Final = "throw"
TOOL: Final = ("gripper", "finger_1", "finger_2")
# The wall is out of reach. Upper arm and shoulder never come near the floor before the forearm does.
FLOOR: Final = tuple((part, "floor") for part in ("forearm", "wrist_1", "wrist_2", "wrist_3", "gripper"))
FOLLOW: Final = 0.04  # how long arm and ball are simulated together after the release [s]
FREE: Final = 0.12  # distance to the wall, or to the rim's height, at which simulation replaces the formula [m]
CHUNK: Final = 0.05  # [s]
LONGEST: Final = 3.0  # of a flight [s]


def make_arm() -> Arm:
    """The arm with its gripper; the tool's position is the middle of a ball that it holds."""
    return Arm(scene_xml(FOLDER), "grip")


def make_simulation() -> Simulation:
    """The whole scene, simulated."""
    return Simulation(load_spec(FOLDER), "touch_gripper")


def make_ball_alone() -> BallAlone:
    """The scene without the arm, simulated."""
    return BallAlone(load_spec(FOLDER))


def make_check(arm: Arm) -> CollisionCheck:
    """Measures the arm's distance to the floor, its pedestal and itself."""
    return CollisionCheck(arm, (*FLOOR, *own_pairs(*TOOL)))


@final
@dataclass(frozen=True, slots=True)
class Flight:
    """A thrown ball, times from the start of the swing.

    Attributes:
        released: The ball as it leaves the gripper.
        passage: Where it passes wall and bin in free flight.
        inside: Whether it ended in the bin.
        motion: Arm and ball, at the environment's own times, until the ball's end.
    """

    released: Ball
    passage: Passage
    inside: bool
    motion: Motion


class Environment(Protocol):
    """A way to execute throws."""

    def throw(self, layout: Layout, swing: JointTrajectory, release: float) -> Flight:
        """Executes `swing` and lets go at `release` [s]; raises `Diverged` if that fails."""


@final
class AnalyticEnvironment:
    """Executes throws by formulas alone."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm

    def throw(self, layout: Layout, swing: JointTrajectory, release: float) -> Flight:
        """Executes `swing` and lets go at `release` [s]."""
        position, velocity, _ = swing.sample(np.array([release]))
        grip = self._arm.tool(position[0], velocity[0])
        released = Ball(*grip.position.tolist(), *grip.velocity.tolist())
        passage = Passage.of(released, layout)
        times = np.arange(0.0, release, STEP / 2)
        joints = swing.sample(times)[0]
        held = Motion(times, joints, np.array([self._arm.tool(row).position for row in joints]))
        flown = held.continued(swing, AIR.path(released, passage.landing_time or 1.0, STEP / 2), release)
        return Flight(released, passage, passage.is_clear, flown)


@final
class ContactEnvironment:
    """Executes throws in the contact simulation; the same situation and swing give the same bits."""

    def __init__(self, arm: Arm, simulation: Simulation) -> None:
        self._arm = arm
        self._simulation = simulation
        self._alone = make_ball_alone()

    def throw(self, layout: Layout, swing: JointTrajectory, release: float) -> Flight:
        """Executes `swing` and lets go at `release` [s]; raises `Diverged` if the simulator breaks down."""
        step, simulation = self._simulation.timestep, self._simulation
        for scene in (simulation, self._alone):
            scene.place("wall", layout.wall)
            scene.place("bin", layout.bin)
        held = int(np.ceil(release / step))
        times = release + step * np.arange(-held, round(FOLLOW / step), dtype=np.float64)  # lets go between two
        controls = tracking_controls(self._arm, simulation.gains, swing, times)
        simulation.activate("grip", on=True)
        carried = simulation.run(simulation.start_held(swing.position[0], "grip"), controls[:held]).states
        simulation.activate("grip", on=False)
        freed = simulation.run(carried[-1], controls[held:]).states
        states = np.concatenate([carried, freed[1:]])
        motion = Motion(np.append(times, times[-1] + step), states[:, ARM_POSITION], states[:, BALL_POSITION])
        return self._ended(layout, swing, motion, freed)

    def _ended(self, layout: Layout, swing: JointTrajectory, motion: Motion, freed: Array) -> Flight:
        """The flight to its end: by formula until the ball comes near what it may touch, then in simulation."""
        ball, time = _ball(freed[-1]), float(motion.time[-1])
        spin = rotated(freed[-1:, BALL_ROTATION], freed[-1:, BALL_SPIN])[0]
        passage = Passage.of(ball, layout)
        over = passage.clearance > FREE
        near = AIR.fly_to_height(ball, RIM + FREE) if over else AIR.fly_to_x(ball, layout.wall_x - FREE)
        if near is not None and ball.x < layout.wall_x - FREE:
            motion = motion.continued(swing, AIR.path(ball, near[0], STEP), time)
            time, ball = time + near[0], near[1]
        rows, inside = np.array([[*ball, *spin]]), None
        while inside is None and len(rows) < LONGEST / self._alone.timestep:
            rows = np.concatenate([rows, self._alone.path(rows[-1, :6], CHUNK, rows[-1, 6:])[1:]])
            inside = _inside(layout, rows[-1])
        later = self._alone.timestep * np.arange(len(rows), dtype=np.float64)
        motion = motion.continued(swing, (later, rows[:, :3]), time)
        return Flight(_ball(freed[0]), passage, bool(inside), motion)


def make_environment(name: str, arm: Arm, simulation: Simulation) -> Environment:
    """The environment of that name, one of `ENVIRONMENTS`."""
    return ContactEnvironment(arm, simulation) if name == "contact" else AnalyticEnvironment(arm)


def _inside(layout: Layout, row: Array) -> bool | None:
    """Whether a ball (9,) stays in the bin; None while undecided."""
    over = np.abs(row[:2] - layout.bin[:2]).max()
    if over < OPENING:
        return True if row[2] + 0.5 * row[5] ** 2 / GRAVITY < RIM else None
    return False if over > OPENING + 2 * BALL_RADIUS and row[2] < RIM else None


def _ball(state: Array) -> Ball:
    return Ball(*state[BALL_POSITION].tolist(), *state[BALL_VELOCITY].tolist())
