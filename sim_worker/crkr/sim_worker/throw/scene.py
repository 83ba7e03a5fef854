"""The scene of the throw, for the simulator, for kinematics, and for collisions."""

from __future__ import annotations

from typing import Final

from crkr.sim_worker.arm.collision import CollisionCheck, own_pairs
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.simulation.scene_file import scene_xml
from crkr.sim_worker.simulation.simulation import BallAlone, Simulation, load_spec

__all__ = ["make_arm", "make_ball_alone", "make_check", "make_simulation"]

FOLDER: Final = "throw"
TOOL: Final = ("gripper", "finger_1", "finger_2")
# The wall is out of reach. Upper arm and shoulder never come near the floor before the forearm does.
FLOOR: Final = tuple((part, "floor") for part in ("forearm", "wrist_1", "wrist_2", "wrist_3", "gripper"))


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
