"""The scene of table tennis, for the simulator, for kinematics, and for collisions."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from crkr.sim_worker.arm.collision import CollisionCheck, own_pairs
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.simulation.scene_file import scene_xml
from crkr.sim_worker.simulation.simulation import BallAlone, Simulation, load_spec
from crkr.sim_worker.table_tennis.ball.constants import BALL_MASS, BALL_RADIUS, MAGNUS

__all__ = ["load_scene", "make_arm", "make_ball_alone", "make_check", "make_simulation"]

FOLDER: Final = "table_tennis"
TOOL: Final = ("handle", "paddle")
# The net is out of the reach of the stretched arm, by more than 10 cm. Upper arm and shoulder never come near the table
# before the forearm does.
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
