"""Plays with a known end are judged as the rules say."""

import re

import numpy as np
import pytest

from crkr.sim_worker.arm.dynamics import ToolPose
from crkr.sim_worker.table_tennis.ball.constants import FACE_OFFSET
from crkr.sim_worker.table_tennis.ball.flight import Ball, flight, fly_to_height
from crkr.sim_worker.table_tennis.environments.play import Play
from crkr.sim_worker.table_tennis.spec import COST
from crkr.sim_worker.table_tennis.tracker import cost_of, judge

CENTRE, NORMAL = np.array([-1.5, 0.1, 1.0]), np.array([0.96, 0.0, 0.28])


def _play(after: Ball, *, miss: tuple[float, float, float] = (0.0, 0.0, 0.0), touched: bool = True) -> Play:
    point = CENTRE + FACE_OFFSET * NORMAL + miss
    x, y, z = point.tolist()
    return Play(
        hit_time=0.6,
        ball=Ball(x, y, z, 0.0, 0.0, 0.0),
        untouched=point,
        paddle=ToolPose(CENTRE, NORMAL, np.zeros(3), np.zeros(3)),
        touched=touched,
        end=0.72,
        after=after,
        time=np.array([0.0, 0.72]),
        joints=np.zeros((2, 6)),
        path=np.zeros((2, 3)),
    )


@pytest.mark.parametrize(
    ("velocity", "reason", "paper", "strict"),
    [
        ((4.0, 0.0, 2.0), "returned", True, True),
        ((2.0, 0.0, 1.0), "own_half", True, False),
        ((7.0, 0.0, 0.3), "net", False, False),
        ((7.0, 0.0, 2.5), "long", False, False),
        ((3.7, 2.0, 2.3), "out", False, False),
        ((0.1, 0.0, -1.0), "short", False, False),
        ((-1.0, 0.0, 2.0), "backwards", False, False),
    ],
)
def test_each_end_has_its_reason(velocity: tuple[float, float, float], reason: str, paper: bool, strict: bool) -> None:
    verdict = judge(_play(Ball(-1.4, 0.1, 1.05, *velocity)))
    assert (verdict.reason, verdict.paper, verdict.strict) == (reason, paper, strict)


def test_a_ball_that_leaves_below_the_table_is_no_return() -> None:
    assert judge(_play(Ball(-1.4, 0.1, 0.7, 4.0, 0.0, 0.0))).reason == "below"


def test_without_a_touch_nothing_that_follows_counts() -> None:
    verdict = judge(_play(Ball(-1.4, 0.1, 1.05, 4.0, 0.0, 2.0), touched=False))
    assert (verdict.reason, verdict.paper, verdict.strict) == ("miss", False, False)
    assert verdict.landing is None
    assert np.isnan(verdict.outcome[3:]).all()
    assert np.isfinite(verdict.outcome[:3]).all()


def test_a_return_around_the_net_post_is_legal() -> None:
    low = Ball(-0.4, 1.05, 0.84, 5.0, -2.3, 0.3)
    crossing = flight(low, 0.4 / 5.0)
    assert crossing.y > 0.84
    assert judge(_play(Ball(-0.4, 1.35, 0.84, 5.0, -3.0, 0.9))).reason == "returned"


def test_the_outcome_is_the_signed_miss_and_the_signed_landing_error() -> None:
    after = Ball(-1.4, 0.1, 1.05, 4.0, 0.0, 2.0)
    landing = fly_to_height(after, 0.78)
    assert landing is not None
    outcome = judge(_play(after, miss=(0.01, -0.02, 0.03))).outcome
    assert outcome == pytest.approx([0.01, -0.02, 0.03, landing[1].x - 0.75, landing[1].y])


def test_the_landing_error_ignores_the_net() -> None:
    """So that it stays a smooth function of the goal where the ball is stopped."""
    verdict = judge(_play(Ball(-1.4, 0.0, 1.05, 7.0, 0.0, 0.3)))
    assert verdict.reason == "net"
    assert verdict.outcome[3] == pytest.approx(0.313 - 0.75, abs=0.001)


def test_the_cost_saturates_as_equation_8() -> None:
    assert cost_of(0.0) == 0.0
    assert cost_of(0.02) == pytest.approx(1 - np.exp(-(0.02**2) / (2 * 6e-4)))
    assert cost_of(0.075) > 0.99
    assert cost_of(10.0) == 1.0


def test_the_tasks_description_says_what_a_distance_costs() -> None:
    said = re.findall(r"(\d\.\d+) at (\d+) cm", COST)
    assert len(said) == 2
    assert [f"{cost_of(int(distance) / 100):.2f}" for _, distance in said] == [cost for cost, _ in said]
    distances = np.linspace(0, 0.2, 50)
    assert (np.diff([cost_of(d) for d in distances]) > 0).all()


def test_the_cost_is_measured_from_the_face_and_not_from_the_blades_middle() -> None:
    verdict = judge(_play(Ball(-1.4, 0.1, 1.05, 4.0, 0.0, 2.0)))
    assert verdict.cost == pytest.approx(0.0, abs=1e-12)
