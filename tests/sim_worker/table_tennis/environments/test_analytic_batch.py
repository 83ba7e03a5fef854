"""The batched analytic game is the scalar one."""

import numpy as np
import pytest

from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.arm.forward_kinematics import Chain
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.environments.analytic_batch import AnalyticBatch
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

SCALES = np.array([0.03] * 6 + [0.1] * 6 + [0.006])


@pytest.fixture(scope="module")
def trials() -> tuple[TableTennis, np.ndarray, np.ndarray]:
    """Balls with goals that are perfect, somewhat and badly disturbed."""
    skill, rng = TableTennis(SkillOptions(environment="analytic"), traces=False), np.random.default_rng(3)
    balls: list[np.ndarray] = []
    goals: list[np.ndarray] = []
    while len(balls) < 120:
        ball = skill.reset(rng)
        plan = skill.plan(ball)
        if plan is not None:
            balls.append(ball)
            goals.append(plan[0] + rng.normal(size=13) * SCALES * rng.choice([0, 1, 3]))
    return skill, np.array(balls), np.array(goals)


def test_batched_kinematics_are_the_arms(arm: Arm) -> None:
    joints, speeds = np.random.default_rng(0).uniform(-3, 3, (2, 50, 6))
    faces = Chain(arm).faces(joints, speeds)
    for row in range(50):
        alone = arm.tool(joints[row], speeds[row])
        for many, one in zip(faces, alone, strict=True):
            assert many[row] == pytest.approx(one, abs=1e-12)


def test_batched_trials_agree_with_scalar_ones(trials: tuple[TableTennis, np.ndarray, np.ndarray], arm: Arm) -> None:
    skill, balls, goals = trials
    result = AnalyticBatch(arm).play(balls, goals)
    alone = [skill.attempt(ball, goal) for ball, goal in zip(balls, goals, strict=True)]
    for name in ("strict", "paper"):
        rate = np.array([outcome.info["outcomes"][name] for outcome in alone])
        assert 0.3 < rate.mean() < 1.0
        assert (rate == getattr(result, name)).mean() >= 0.97
    both = result.executed & np.array([outcome.executed for outcome in alone])
    assert both.mean() > 0.9
    costs = np.array([outcome.cost if outcome.cost is not None else np.nan for outcome in alone])
    assert np.abs(result.cost - costs)[both].max() < 0.05
    assert np.isnan(result.cost[~result.executed]).all()


def test_what_cannot_be_done_is_refused(trials: tuple[TableTennis, np.ndarray, np.ndarray], arm: Arm) -> None:
    _, balls, goals = trials
    hasty, low = goals[:20].copy(), goals[:20].copy()
    hasty[:, 12], hasty[:, 0] = 0.25, hasty[:, 0] + 1.5
    low[:, 1] += 0.5
    batch = AnalyticBatch(arm)
    assert not batch.play(balls[:20], hasty).executed.any()
    assert not batch.play(balls[:20], low).executed.all()


def test_a_trial_does_not_depend_on_its_company(trials: tuple[TableTennis, np.ndarray, np.ndarray], arm: Arm) -> None:
    _, balls, goals = trials
    batch = AnalyticBatch(arm)
    together = batch.play(balls, goals)
    for row in (0, 17, 80):
        alone = batch.play(balls[row : row + 1], goals[row : row + 1])
        assert alone.cost[0] == pytest.approx(together.cost[row], abs=1e-9, nan_ok=True)
        assert (alone.strict[0], alone.paper[0]) == (together.strict[row], together.paper[row])


def test_balls_that_never_reach_the_net_are_judged_like_any_other(
    trials: tuple[TableTennis, np.ndarray, np.ndarray], arm: Arm
) -> None:
    """Bold exploration has many that are missed or leave slowly: they overflow nowhere and upset no neighbour."""
    skill, balls, goals = trials
    rng = np.random.default_rng(4)
    wild = goals + rng.normal(size=goals.shape) * SCALES * 8
    result = AnalyticBatch(arm).play(balls, wild)
    alone = [skill.attempt(ball, goal) for ball, goal in zip(balls, wild, strict=True)]
    assert sum(outcome.info["reason"] == "miss" for outcome in alone) > 20
    strict = np.array([outcome.info["outcomes"]["strict"] for outcome in alone])
    assert (strict == result.strict).mean() >= 0.97
