import numpy as np
import pytest

from crkr.sim_worker.table_tennis.arm import Arm
from crkr.sim_worker.table_tennis.collision import CollisionCheck
from crkr.sim_worker.table_tennis.constants import PADDLE_HALF_THICKNESS, PADDLE_RADIUS, TABLE_HEIGHT
from crkr.sim_worker.table_tennis.planner import HOME, POSTURE

NORMAL = np.array([1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def check(arm: Arm) -> CollisionCheck:
    return CollisionCheck(arm)


def test_the_arm_at_home_touches_nothing(check: CollisionCheck) -> None:
    assert check.first(HOME[None]) is None


@pytest.mark.parametrize(("gap", "collides"), [(0.005, True), (0.015, False), (-0.02, True)])
def test_the_paddle_keeps_one_centimetre_from_the_table(
    check: CollisionCheck, arm: Arm, gap: float, collides: bool
) -> None:
    """An upright blade over the table: its lowest point is a radius below its centre."""
    joints = arm.reach(np.array([-1.3, 0.0, TABLE_HEIGHT + PADDLE_RADIUS + gap]), NORMAL, POSTURE)
    assert (check.first(joints[None]) is not None) == collides


def test_beside_the_table_the_paddle_may_be_low(check: CollisionCheck, arm: Arm) -> None:
    far = arm.reach(np.array([-1.37 - PADDLE_HALF_THICKNESS - 0.015, 0.0, TABLE_HEIGHT]), NORMAL, POSTURE)
    assert check.first(far[None]) is None
    near = arm.reach(np.array([-1.37 - PADDLE_HALF_THICKNESS - 0.005, 0.0, TABLE_HEIGHT]), NORMAL, POSTURE)
    assert check.first(near[None]) == 0


def test_the_first_sample_that_collides_is_named(check: CollisionCheck, arm: Arm) -> None:
    low = arm.reach(np.array([-1.3, 0.0, TABLE_HEIGHT]), NORMAL, POSTURE)
    assert check.first(np.array([HOME, POSTURE, low, HOME, low])) == 2
