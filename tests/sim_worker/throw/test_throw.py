"""The skill as workers use it."""

import numpy as np
import pytest

from crkr.client.tally import Tally
from crkr.experiments.learning.run import Course, learn_once
from crkr.protocol import Invalid, TaskSpec
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import Skill, SkillOptions, TrialResult
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.throw import Throw
from crkr.sim_worker.throw.layouts import LAUNCHERS, Layout

Planned = tuple[np.ndarray, np.ndarray]
PAN, SPEEDS, TIME = 0, slice(4, 7), 7


@pytest.fixture(scope="module")
def planned(contact: Throw) -> Planned:
    """A state, and a goal that succeeds in it."""
    state = contact.reset(np.random.default_rng(5))
    plan = contact.plan(state)
    assert plan is not None
    return state, plan[0]


def _measured(result: TrialResult) -> np.ndarray:
    assert result.outcome is not None
    return result.outcome


def test_it_is_an_installed_skill() -> None:
    skill: Skill = load_skill("throw", SkillOptions(name="lob", seed=3))
    spec = skill.spec()
    assert (spec.name, spec.seed, len(spec.state), len(spec.goal), len(spec.outcome)) == ("lob", 3, 4, 8, 4)
    assert TaskSpec.from_dict(spec.to_dict()) == spec
    assert isinstance(skill, Throw)
    assert (skill.options.environment, skill.options.launcher, skill.options.preset) == ("contact", "nominal", "tuned")


@pytest.mark.parametrize(
    "options", [SkillOptions(environment="hybrid"), SkillOptions(launcher="cannon"), SkillOptions(preset="paper")]
)
def test_an_unknown_option_is_refused_with_what_there_is(options: SkillOptions) -> None:
    with pytest.raises(Invalid, match="there are"):
        Throw(options)


@pytest.mark.parametrize("launcher", ["nominal", "wide"])
@pytest.mark.parametrize("environment", ["contact", "analytic"])
def test_the_planner_succeeds_nearly_always(launcher: str, environment: str) -> None:
    skill = Throw(SkillOptions(environment=environment, launcher=launcher), traces=False)
    tally = Tally()
    for context in range(25):
        tally.add(skill.best_plan(skill.reset(fresh_rng(12, context))))
    assert tally.rate("success") >= 0.96


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_situation_is_fair_and_in_the_box_of_states(launcher: str) -> None:
    skill, rng = Throw(SkillOptions(launcher=launcher, environment="analytic")), np.random.default_rng(0)
    box = skill.spec().state
    for _ in range(200):
        state = skill.reset(rng)
        assert all(axis.low <= value <= axis.high for axis, value in zip(box, state, strict=True))
        assert Layout.of(state).is_fair


def test_demonstrations_succeed_and_repeat_by_seed(contact: Throw) -> None:
    shown, again = (contact.demonstrations(3, np.random.default_rng(4)) for _ in range(2))
    assert [one.goal.tobytes() for one in shown] == [one.goal.tobytes() for one in again]
    for one in shown:
        assert (one.result.executed, one.result.success, one.result.info["reason"]) == (True, True, "in")
        assert one.result.cost is not None
        assert one.result.cost < 0.05


def test_the_same_situation_and_goal_give_the_same_bits(contact: Throw, planned: Planned) -> None:
    state, goal = planned
    first = contact.attempt(state, goal)
    contact.attempt(state + 0.1, goal * (1 - 1e-3))
    for result in (contact.attempt(state, goal), Throw(SkillOptions()).attempt(state, goal)):
        assert _measured(result).tobytes() == _measured(first).tobytes()
        assert result.cost == first.cost


@pytest.mark.parametrize("environment", ["contact", "analytic"])
@pytest.mark.parametrize(
    ("shift", "reason", "entry", "sign"),
    [
        ((0.3, 0.0, 0.0, 0.0), "short", 0, -1),  # the bin stands farther away than the throw was meant for
        ((0.0, 0.3, 0.0, 0.0), "beside", 1, -1),  # the bin stands more to the left: the ball passes on its right
        ((0.0, -0.3, 0.0, 0.0), "beside", 1, 1),
        ((0.0, 0.0, 0.0, 1.5), "wall", 2, -1),
    ],
)
def test_outcomes_tell_on_which_side_a_throw_failed(
    request: pytest.FixtureRequest,
    planned: Planned,
    environment: str,
    shift: tuple[float, ...],
    reason: str,
    entry: int,
    sign: int,
) -> None:
    skill: Throw = request.getfixturevalue(environment)
    state, goal = planned
    good, moved = skill.attempt(state, goal), skill.attempt(state + np.array(shift), goal)
    assert (good.success, good.info["reason"]) == (True, "in")
    assert (moved.executed, moved.success, moved.info["reason"]) == (True, False, reason)
    change = _measured(moved) - _measured(good)
    assert change[:3] == pytest.approx([-shift[0], -shift[1], -shift[3]], abs=1e-9)
    assert sign * _measured(moved)[entry] > 0.1
    assert moved.cost is not None
    assert moved.cost > 0.8


def test_a_faster_arm_throws_farther_and_a_turned_one_more_to_the_left(contact: Throw, planned: Planned) -> None:
    state, goal = planned
    fast, turned = goal.copy(), goal.copy()
    fast[SPEEDS] *= 1.05
    turned[PAN] += 0.1
    usual = _measured(contact.attempt(state, goal))
    assert _measured(contact.attempt(state, fast))[0] > usual[0] + 0.05
    assert _measured(contact.attempt(state, turned))[1] > usual[1] + 0.1


def test_a_release_without_time_is_infeasible_and_still_measured(contact: Throw, planned: Planned) -> None:
    state, goal = planned
    hasty = goal.copy()
    hasty[TIME] = contact.spec().goal[TIME].low
    hasty[PAN] = contact.spec().goal[PAN].high
    hasty[SPEEDS] = [axis.high for axis in contact.spec().goal[SPEEDS]]
    result = contact.attempt(state, hasty)
    assert (result.executed, result.cost, result.info["reason"], result.trace) == (False, None, "infeasible", None)
    assert np.isfinite(_measured(result)).all()
    assert _measured(result)[3] < 0.02
    assert contact.film(hasty, 0.1) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, 100.0])
@pytest.mark.parametrize("place", range(8))
def test_a_goal_that_is_not_finite_or_out_of_bounds_is_refused(
    contact: Throw, planned: Planned, bad: float, place: int
) -> None:
    state, goal = planned
    wrong = goal.copy()
    wrong[place] = bad
    result = contact.attempt(state, wrong)
    assert (result.executed, result.success, result.cost, result.outcome) == (False, False, None, None)
    assert result.info["reason"] == "invalid"
    assert contact.attempt(state, np.zeros(5)).info["reason"] == "invalid"


def test_executing_before_a_reset_is_a_mistake() -> None:
    with pytest.raises(Invalid, match="reset"):
        Throw(SkillOptions()).execute(np.zeros(8))


@pytest.mark.parametrize("environment", ["contact", "analytic"])
def test_a_trace_shows_wall_and_bin_where_they_stand_and_the_ball_until_it_is_in(
    request: pytest.FixtureRequest, planned: Planned, environment: str
) -> None:
    skill: Throw = request.getfixturevalue(environment)
    state, goal = planned
    skill.restore(state)
    trace = skill.execute(goal).trace
    assert trace is not None
    assert {geom.body for geom in skill.scene()} <= {"world", *trace.bodies}
    assert (np.diff(trace.time) > 0).all()
    wall, bin_ = (trace.positions[:, trace.bodies.index(name)] for name in ("wall", "bin"))
    assert (wall == [state[2], 0.0, state[3]]).all()
    assert (bin_[:, :2] == state[:2]).all()
    path = trace.paths["ball"]
    hand = trace.positions[:, trace.bodies.index("wrist_3")]
    held = trace.time < goal[TIME]
    assert np.linalg.norm((path - hand)[held], axis=1) == pytest.approx(np.full(held.sum(), 0.25), abs=2e-3)
    assert np.abs(path[-1, :2] - state[:2]).max() < 0.15
    assert path[-1, 2] < 0.36


def test_it_is_learned_without_a_demonstration_in_some_dozens_of_trials(analytic: Throw) -> None:
    run = learn_once(analytic, Course(trials=80, contexts=40, judge=5, demonstrations=0, marks=(0, 10)), 3)
    assert [score.trials for score in run.curve] == [10, 80]
    assert run.curve[0].tally.rate("success") < 0.7
    assert run.final.tally.rate("success") >= 0.85
