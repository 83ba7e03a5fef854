"""The arm is the maker's UR10e where the page says so, and departs from it by what the page says."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from crkr.sim_worker.arm.dynamics import SPEED_LIMITS
from crkr.sim_worker.simulation.simulation import Simulation

PAGE = (Path(__file__).parents[3] / "docs/table-tennis.md").read_text()
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
NUMBER = re.compile(r"−?\d+(?:\.\d+)?")

# Universal Robots, "DH Parameters for calculations of kinematics and dynamics": a [m], d [m] and alpha [rad] by joint.
A = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)
D = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
UPRIGHT = np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])  # of the maker's joints, where the scene's are zero

MAKER = {
    "DH a [m]": A,
    "DH d [m]": D,
    "position limits [± °]": (360.0, 360.0, 180.0, 360.0, 360.0, 360.0),
    "speed limits [°/s]": (120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
    "torque limits [N m]": (330.0, 330.0, 150.0, 56.0, 56.0, 56.0),
    "masses [kg]": (7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
    "centre of mass, DH x [m]": (0.021, 0.38, 0.24, 0.0, 0.0, 0.0),
    "centre of mass, DH y [m]": (0.0, 0.0, 0.0, 0.007, 0.007, 0.0),
    "centre of mass, DH z [m]": (0.027, 0.158, 0.068, 0.018, 0.018, -0.026),
}


def _documented(quantity: str, column: int) -> list[float]:
    """The six numbers of a row of the page's table: column 1 the scene's, 2 the maker's."""
    row = next(line for line in PAGE.splitlines() if line.startswith(f"| {quantity} |"))
    cell = row.strip("|").split("|")[column]
    return [float(number.replace("−", "-")) for number in NUMBER.findall(cell)]


def _frames(joints: np.ndarray) -> list[np.ndarray]:
    """Poses (4, 4) of the maker's link frames for the scene's `joints` (6,); the base faces the table."""
    pose, frames = np.diag([-1.0, -1.0, 1.0, 1.0]), []
    for angle, a, d, alpha in zip(joints + UPRIGHT, A, D, ALPHA, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
        frames.append(pose)
    return frames


def _scenes(simulation: Simulation) -> dict[str, np.ndarray]:
    model = simulation.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    ids = [model.body(name).id for name in LINKS]
    centres = [
        frame[:3, :3].T @ (data.xipos[index] - data.body("base").xpos - frame[:3, 3])
        for index, frame in zip(ids, _frames(np.zeros(6)), strict=True)
    ]
    along = {f"centre of mass, DH {axis} [m]": np.array(centres)[:, k] for k, axis in enumerate("xyz")}
    return {
        "position limits [± °]": np.rad2deg(model.jnt_range[:6, 1]),
        "speed limits [°/s]": np.rad2deg(SPEED_LIMITS),
        "torque limits [N m]": np.array(model.actuator_forcerange[:, 1]),
        "masses [kg]": np.array(model.body_mass[ids]),
        **along,
    }


def test_the_flange_is_where_the_makers_parameters_put_it(simulation: Simulation) -> None:
    model = simulation.model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(100):
        joints = rng.uniform(-3, 3, 6)
        data.qpos[:6] = joints
        mujoco.mj_kinematics(model, data)
        flange = _frames(joints)[-1]
        turn = data.body("wrist_3").xmat.reshape(3, 3)
        there = data.body("wrist_3").xpos + D[5] * turn[:, 1] - data.body("base").xpos
        assert np.abs(there - flange[:3, 3]).max() < 1e-12
        # The scene's last link has its y along the maker's z.
        assert np.abs(turn - flange[:3, [0, 2, 1]] * [1, 1, -1]).max() < 1e-12


def test_limits_are_symmetric_as_the_page_writes_them(simulation: Simulation) -> None:
    model = simulation.model
    assert model.jnt_range[:6, 0].tolist() == (-model.jnt_range[:6, 1]).tolist()
    assert model.actuator_forcerange[:, 0].tolist() == (-model.actuator_forcerange[:, 1]).tolist()


@pytest.mark.parametrize("quantity", MAKER)
def test_the_page_has_the_makers_number(quantity: str) -> None:
    assert _documented(quantity, 2) == list(MAKER[quantity])


@pytest.mark.parametrize("quantity", [name for name in MAKER if not name.startswith("DH")])
def test_the_page_has_the_scenes_number(simulation: Simulation, quantity: str) -> None:
    rounding = 5.1e-4 if quantity.startswith("centre") else 1e-3
    assert _documented(quantity, 1) == pytest.approx(_scenes(simulation)[quantity], abs=rounding)


@pytest.mark.parametrize("quantity", MAKER)
def test_the_scene_departs_from_the_maker_only_in_the_paddles_mass_and_centres_of_mass(quantity: str) -> None:
    ours, theirs = np.array(_documented(quantity, 1)), np.array(MAKER[quantity])
    if quantity.startswith("centre"):
        assert np.abs(ours - theirs).max() < 0.09
    elif quantity == "masses [kg]":
        assert ours - theirs == pytest.approx([0, 0, 0, 0, 0, 0.18])
    else:
        assert ours.tolist() == theirs.tolist()
