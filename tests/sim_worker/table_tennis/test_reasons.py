"""Every way in which a trial can end, played for real in every environment."""

import numpy as np
import pytest

from crkr.sim_worker.arm.collision import MARGIN
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.skill import SkillOptions, TrialResult
from crkr.sim_worker.table_tennis.ball.constants import FACE_OFFSET, TABLE_HALF_LENGTH, TABLE_HEIGHT
from crkr.sim_worker.table_tennis.environments.environments import ENVIRONMENTS, make_predictor
from crkr.sim_worker.table_tennis.planner import HOME, POSTURE
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

SKILLS = {name: TableTennis(SkillOptions(environment=name), traces=False) for name in ENVIRONMENTS}
PLAYED = ("returned", "miss", "backwards", "own_half", "net", "long", "short", "out")
REFUSED = ("invalid", "infeasible", "collision")


def _planned(skill: TableTennis) -> tuple[np.ndarray, np.ndarray]:
    ball = skill.reset(np.random.default_rng(5))
    plan = skill.plan(ball)
    assert plan is not None
    return ball, plan[0]


def _moved(goal: np.ndarray, joint: int, angle: float) -> np.ndarray:
    """The goal with one joint elsewhere at the hit [rad]."""
    return np.asarray(goal + angle * np.eye(13)[joint])


def _faster(goal: np.ndarray, factor: float) -> np.ndarray:
    """The goal with all joints that many times faster at the hit."""
    return np.concatenate([goal[:6], factor * goal[6:12], goal[12:]])


def _turned(arm: Arm, goal: np.ndarray, pitch: float, yaw: float, speed: float) -> np.ndarray:
    """The goal with the face turned about the ball [rad], moving `speed` times as fast as before, the same way."""
    paddle = arm.tool(goal[:6], goal[6:12])
    x, y, z = paddle.normal
    x, z = np.cos(pitch) * x - np.sin(pitch) * z, np.sin(pitch) * x + np.cos(pitch) * z
    normal = np.array([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, z])
    joints = arm.reach(paddle.position + FACE_OFFSET * (paddle.normal - normal), normal, goal[:6])
    return np.concatenate([joints, arm.speeds_for(joints, speed * paddle.velocity), goal[12:]])


def _goal(reason: str, arm: Arm, good: np.ndarray) -> np.ndarray:
    match reason:
        case "returned":
            return good
        case "invalid":
            return _moved(good, 4, np.nan)
        case "infeasible":  # the hand would have to turn by 1.1 rad in 0.25 s
            return np.concatenate([_moved(good, 4, HOME[4] + 1.1 - good[4])[:12], [0.25]])
        case "collision":  # the upper arm leans forward until the hand is in the table
            return _moved(good, 1, 0.4)
        case "miss":
            return _moved(good, 0, -0.3)
        case "backwards":  # a still face, turned far aside
            return _turned(arm, good, -0.2, -0.9, 0.0)
        case "own_half":  # too slow
            return _faster(good, 0.3)
        case "net":  # the face closes
            return _moved(good, 3, 0.29)
        case "long":
            return _faster(good, 1.5)
        case "short":  # down beside the table's end
            return _turned(arm, good, -0.6, -0.9, 0.5)
        case "out":
            return _turned(arm, good, -0.1, -0.6, 1.0)
    raise AssertionError(reason)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("reason", PLAYED)
def test_each_end_of_an_executed_trial_happens(arm: Arm, environment: str, reason: str) -> None:
    skill = SKILLS[environment]
    ball, good = _planned(skill)
    outcome = skill.attempt(ball, _goal(reason, arm, good))
    assert (outcome.info["reason"], outcome.executed) == (reason, True)
    strict, paper = reason == "returned", reason in ("returned", "own_half")
    assert outcome.info["outcomes"] == {"paper": paper, "strict": strict}
    assert outcome.success == strict
    _plausible(outcome, reason)


def _plausible(outcome: TrialResult, reason: str) -> None:
    """Where the ball came down, as far as the outcome tells, is where the reason says."""
    assert outcome.outcome is not None
    x, y = outcome.outcome[3] + 0.75, outcome.outcome[4]
    inside = {
        "returned": 0 <= x <= TABLE_HALF_LENGTH,
        "own_half": -TABLE_HALF_LENGTH <= x < 0,
        "long": x > TABLE_HALF_LENGTH,
        "short": x < -TABLE_HALF_LENGTH,
        "out": abs(y) > 0.7625,
        "miss": bool(np.isnan(x)),
    }
    assert inside.get(reason, True)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("reason", REFUSED)
def test_each_reason_to_refuse_a_goal_happens(arm: Arm, environment: str, reason: str) -> None:
    skill = SKILLS[environment]
    ball, good = _planned(skill)
    outcome = skill.attempt(ball, _goal(reason, arm, good))
    assert (outcome.info["reason"], outcome.executed, outcome.success) == (reason, False, False)
    assert (outcome.cost, outcome.trace) == (None, None)
    if reason == "invalid":
        assert outcome.outcome is None
        return
    assert outcome.outcome is not None
    assert np.isnan(outcome.outcome[3:5]).all()  # nothing landed; where face and ball would have been is known
    assert np.isfinite(np.delete(outcome.outcome, [3, 4, 6])).all()
    spare, clearance = outcome.outcome[5:]
    assert (spare < 0) if reason == "infeasible" else (clearance < MARGIN)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_a_ball_met_under_the_tables_height_leaves_below(arm: Arm, environment: str) -> None:
    """A slow ball that drops behind the table, stopped there by a still, upright face."""
    ball = np.array([0.5, 0.0, 1.1, -4.4, 0.0, -0.6])
    predictor = make_predictor(environment)
    path = predictor.path(ball, 1.0)
    row = int(np.flatnonzero((path[:, 2] < TABLE_HEIGHT - 0.02) & (path[:, 0] < -TABLE_HALF_LENGTH))[0])
    normal = np.array([1.0, 0.0, 0.0])
    joints = arm.reach(path[row, :3] - FACE_OFFSET * normal, normal, POSTURE)
    goal = np.concatenate([joints, np.zeros(6), [row * predictor.timestep]])
    outcome = SKILLS[environment].attempt(ball, goal)
    assert (outcome.info["reason"], outcome.executed, outcome.success) == ("below", True, False)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("velocity", [1e12, np.nan, np.inf])
def test_a_ball_that_nothing_can_follow_diverges_is_counted_and_forgotten(environment: str, velocity: float) -> None:
    skill = SKILLS[environment]
    ball, good = _planned(skill)
    before, count = skill.attempt(ball, good), skill.diverged
    absurd = ball.copy()
    absurd[3:] = velocity
    outcome = skill.attempt(absurd, good)
    assert (outcome.info["reason"], outcome.executed, outcome.cost) == ("diverged", False, None)
    assert skill.diverged == count + 1
    again = skill.attempt(ball, good)
    assert again.outcome is not None
    assert before.outcome is not None
    assert again.outcome.tobytes() == before.outcome.tobytes()
