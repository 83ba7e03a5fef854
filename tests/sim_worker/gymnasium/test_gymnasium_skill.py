"""Gymnasium's environments as skills."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from small_environments import Aiming, odd, walking

from crkr.learner import Learner
from crkr.protocol import Invalid, geoms_to_wire
from crkr.sim_worker import SkillOptions, load_skill
from crkr.sim_worker.gymnasium import gymnasium_skill
from crkr.sim_worker.gymnasium.observation import rounded_box
from crkr.sim_worker.skill import HasScene, Skill
from crkr.sim_worker.skill_check import check
from crkr.sim_worker.skill_registry import check_skill, default_task

REACHER = Path(__file__).parents[3] / "examples" / "gymnasium_reacher.py"


def share_of_hits(skill: Skill, learner: Learner, count: int) -> float:
    rng = np.random.default_rng(99)
    return float(np.mean([skill.execute(learner.predict(skill.reset(rng)).goal).success for _ in range(count)]))


def learn(skill: Skill, trials: int) -> Learner:
    learner, rng = Learner(skill.spec()), np.random.default_rng(0)
    for _ in range(trials):
        answer = learner.predict(skill.reset(rng), explore=True)
        result = skill.execute(answer.goal)
        learner.report(answer, cost=result.cost, success=result.success, outcome=result.outcome)
    return learner


def test_an_environment_of_one_decision_needs_nothing_but_its_name() -> None:
    skill = gymnasium_skill(Aiming)(SkillOptions(seed=1))
    spec = skill.spec()
    assert (spec.name, spec.seed) == ("aiming", 1)
    assert [axis.name for axis in spec.state] == ["observation_1"], "one is constant, and one follows from another"
    assert [(axis.low, axis.high) for axis in spec.goal] == [(-2.0, 2.0)]
    assert spec.outcome == ()
    assert "better define it" in spec.description
    assert share_of_hits(skill, learn(skill, 150), 100) >= 0.7


def test_what_is_given_is_taken() -> None:
    make = gymnasium_skill(
        Aiming,
        state=["observation_1", "observation_0"],
        goal_bounds=1.0,
        success="near",
        cost=("return", -4.0, 0.0),
        outcome=lambda env, _: {"miss": env.miss},
        tolerance=0.1,
        start=3,
        settings={"budget": 40},
    )
    skill = make(SkillOptions(name="mine"))
    spec = skill.spec()
    assert (spec.name, spec.budget, spec.start.count) == ("mine", 40, 3)
    assert [axis.name for axis in spec.state] == ["observation_1", "observation_0"]
    assert [(axis.low, axis.high) for axis in spec.goal] == [(-1.0, 1.0)]
    assert [(entry.name, entry.tolerance) for entry in spec.outcome] == [("miss", 0.1)]
    state = skill.reset(np.random.default_rng(2))
    result = skill.execute(np.array([state[0] + 0.05]))
    assert result.success
    assert result.outcome == pytest.approx([0.05])
    assert result.cost == pytest.approx(0.05**2 / 4.0)
    again = skill.execute(np.array([state[0] + 0.5]))
    assert not again.success
    assert again.outcome == pytest.approx([0.5]), "a second goal starts from the same reset"


def test_every_worker_finds_the_same_task_and_the_same_situations() -> None:
    one, other = (load_skill("gymnasium:Reacher-v5", SkillOptions()) for _ in range(2))
    assert one.spec() == other.spec()
    assert one.spec().name == default_task("gymnasium:Reacher-v5") == "reacher-v5"
    first, second = (skill.reset(np.random.default_rng(5)) for skill in (one, other))
    assert first == pytest.approx(second, abs=0)
    goal = np.array([0.5, -0.5])
    assert one.execute(goal).info == other.execute(goal).info


def test_reacher_moves_its_joints_to_the_goal_and_learns_where_the_tip_comes_to() -> None:
    skill = load_skill(f"{REACHER}:make", SkillOptions())
    assert [axis.name for axis in skill.spec().goal] == ["joint0", "joint1"]
    skill.reset(np.random.default_rng(0))
    trace = skill.execute(np.array([1.0, 0.7])).trace
    assert trace is not None
    tip = trace.positions[-1, trace.bodies.index("fingertip")]
    elbow = 0.1 * np.array([np.cos(1.0), np.sin(1.0)])
    assert tip[:2] == pytest.approx(elbow + 0.11 * np.array([np.cos(1.7), np.sin(1.7)]), abs=1e-3)
    assert share_of_hits(skill, learn(skill, 20), 100) <= 0.1
    assert share_of_hits(skill, learn(skill, 200), 100) >= 0.25


def test_fetch_reach_is_learned_from_its_name_alone() -> None:
    skill = load_skill("gymnasium:FetchReach-v4", SkillOptions())
    spec = skill.spec()
    assert [axis.name for axis in spec.state] == [f"desired_goal_{index}" for index in range(3)]
    assert [entry.name for entry in spec.outcome] == ["off_0", "off_1", "off_2"]
    assert share_of_hits(skill, learn(skill, 40), 10) >= 0.3


def test_mujocos_shapes_and_sites_are_drawn_where_they_are() -> None:
    skill = load_skill("gymnasium:FetchReach-v4", SkillOptions())
    assert isinstance(skill, HasScene)
    shapes = geoms_to_wire(skill.scene())
    state = skill.reset(np.random.default_rng(0))
    result = skill.execute(np.array([0.0, 0.0, 0.1, 0.0]))
    assert result.trace is not None
    drawn = {shape["body"] for shape in shapes} - {"world"}
    assert drawn == set(result.trace.bodies)
    assert result.trace.positions[:, result.trace.bodies.index("site_target0")] == pytest.approx(
        np.tile(state, (51, 1))
    )
    gripper = result.trace.positions[:, result.trace.bodies.index("robot0:gripper_link"), 2]
    assert gripper[-1] > gripper[0] + 0.05


def test_a_free_object_makes_the_situation_of_fetch_push() -> None:
    spec = gymnasium_skill("FetchPush-v4", via_points=2)(SkillOptions()).spec()
    assert [axis.name for axis in spec.goal][3:5] == ["action_3_at_0", "action_0_at_1"]
    assert [axis.name for axis in spec.state][:2] == ["desired_goal_0", "desired_goal_1"]
    assert 4 <= len(spec.state) <= 8, "of 31 numbers"


@pytest.mark.parametrize(
    ("source", "options", "complaint"),
    [
        ("No-Such-v0", {}, r"there is no environment 'No-Such-v0': .*PACKAGE:ENV-ID"),
        ("no_such_package:Aim-v0", {}, r"No module named 'no_such_package'.*`pip install`"),
        ("Reacher-v5", {"wheels": 4}, "there is no environment 'Reacher-v5': .*wheels"),
        ("CartPole-v1", {}, "takes actions of Discrete, but a goal is a vector of numbers; use"),
        (walking(), {}, r"needs many steps and has no time limit; say how many.*steps=100\)"),
        (walking(action=spaces.Box(-np.inf, np.inf, (2,))), {}, r"action 0 has no bounds; give them: .*goal_bounds=1"),
        (walking(spaces.Box(0, 255, (64, 64, 3), np.uint8)), {"steps": 5}, r"'observation' is an image \(64, 64, 3\)"),
        (
            walking(spaces.Dict({"eye": spaces.Box(0, 255, (8, 9), np.uint8), "arm": spaces.Box(0, 1, (2,))})),
            {"steps": 5},
            r"'eye' is an image .* name the entries to keep: .*state=\[",
        ),
        (
            walking(spaces.Dict({"said": spaces.Text(8)})),
            {"steps": 5},
            "'said' is of Text, but a state is a short vector",
        ),
        (walking(), {"steps": 5, "state": ["speed"]}, "has no observation 'speed'; its entries: "),
        (walking(), {"steps": 5, "state": [2]}, "has no observation 2; its entries: observation; "),
        (walking(), {"steps": 5, "success": "won"}, "tells no 'won' at the end of an episode; it tells nothing"),
        (walking(), {"steps": 5, "outcome": lambda *_: {"off": 1.0}}, "needs a tolerance.*tolerance=0.05"),
        (walking(), {"steps": 5, "outcome": lambda *_: 1.0, "tolerance": 1.0}, "must measure a map of numbers"),
        (walking(), {"steps": 5, "cost": ("return", 1.0, 0.0)}, "WORST < BEST"),
        (walking(), {"steps": 5, "goal_bounds": (2.0, 3.0)}, "leave goals no room"),
        (walking(), {"steps": 5, "goal_bounds": ([0.0, 0.0], 1.0)}, "goal_bounds need one number or 1"),
        (walking(), {"steps": 5, "cost": ("return", 1.0)}, "WORST < BEST"),
        (walking(), {"steps": 0}, "steps must be a whole number from 1 to 1000000; got 0"),
        (walking(), {"steps": 10**12}, "steps must be a whole number"),
        (walking(), {"steps": 5, "via_points": 0}, "via_points must be a whole number from 1 to 256; got 0"),
        (walking(), {"steps": 5, "via_points": 10**9}, "via_points must be a whole number"),
        (walking(action=spaces.Box(-1.7e308, 1.7e308, (1,), np.float64)), {"steps": 5}, "wider than numbers reach"),
        (walking(spaces.Box(-1.0, 1.0, (1001,))), {"steps": 5}, "has 1001 numbers to choose from"),
        (walking(spaces.Box(-1.0, 1.0, (0,))), {"steps": 5}, "has 0 numbers to choose from"),
        (lambda: 5, {}, r"must return a gymnasium.Env; got int"),
        (odd(state=np.nan), {"steps": 5}, "observation_0 is not a finite number"),
        (odd(state=1e305), {"steps": 5}, "observation_0 is not a finite number below 1e.300"),
        (odd(reward=np.nan), {"steps": 5}, "the return of a random episode is nan"),
        (odd(reward=-np.inf), {"steps": 5}, "the return of a random episode is -inf"),
        (odd(info={"is_success": "no"}), {"steps": 5}, "is_success must be true or false; got 'no'"),
        (walking(), {"steps": 5, "settings": {"bugdet": 1}}, "unknown fields in the specification: bugdet"),
    ],
)
def test_an_environment_that_makes_no_skill_is_refused_with_what_to_do(
    source: Any, options: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(Invalid, match=complaint) as refused:
        gymnasium_skill(source, **options)(SkillOptions())
    assert "\n" not in refused.value.message


def test_an_environment_without_shapes_is_no_problem() -> None:
    skill = gymnasium_skill(Aiming, success="near", cost=("return", -4.0, 0.0))(SkillOptions())
    found = {(remark.level, remark.what) for remark in check(skill)}
    assert ("ok", "scene") in found
    assert "problem" not in {level for level, _ in found}


def test_images_are_no_hindrance_where_other_entries_are_named() -> None:
    space = spaces.Dict({"eye": spaces.Box(0, 255, (80, 90, 3), np.uint8), "arm": spaces.Box(-1.0, 1.0, (2,))})
    skill = gymnasium_skill(walking(space), steps=5, state=["arm"])(SkillOptions())
    assert [axis.name for axis in skill.spec().state] == ["arm_0", "arm_1"]
    assert skill.execute(np.zeros(1)).info["return"] == 0.0


def test_options_that_no_environment_has_are_refused() -> None:
    with pytest.raises(Invalid, match="has no --launcher; leave it out"):
        load_skill("gymnasium:Reacher-v5", SkillOptions(launcher="easy"))
    with pytest.raises(Invalid, match=r"names no member; write gymnasium:NAME"):
        check_skill("gymnasium:")


def test_costs_that_tell_trials_apart_no_longer_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    skill = gymnasium_skill(Aiming, success="near", cost=("return", -0.001, 0.0))(SkillOptions())
    rng = np.random.default_rng(0)
    with caplog.at_level(logging.WARNING):
        for _ in range(100):
            skill.reset(rng)
            skill.execute(np.array([2.0]))
    assert [record.message.partition(";")[0] for record in caplog.records] == [
        "more than half of 100 trials are as costly as cost can tell"
    ]


def test_the_box_of_a_state_is_the_same_where_the_last_digits_differ() -> None:
    values = np.random.default_rng(0).normal(size=(50, 3)) * [1e-3, 1.0, 1e3]
    low, high = rounded_box(values)
    assert (low <= values).all()
    assert (high >= values).all()
    assert (high - low <= 1.5 * np.ptp(values, axis=0)).all()
    assert rounded_box(values * (1 + 1e-12))[0].tolist() == low.tolist()
