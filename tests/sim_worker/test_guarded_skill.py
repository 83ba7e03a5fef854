"""What a user's skill may raise or give."""

import json
import os
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crkr.client import Task
from crkr.sim_worker import SkillOptions, load_skill
from crkr.sim_worker.guarded_skill import MOST_FAULTS, GuardedSkill, SkillFault

pytestmark = pytest.mark.usefixtures("skills_here")
Start = Callable[..., Any]
FAULTS = [
    *("raises", "leaves", "panics", "returns nothing", "returns a map", "cost nan", "cost 2", "cost none", "cost text"),
    *("cost of two", "cost of one axis", "outcome too long", "success of two", "info of numbers", "info too large"),
]
HARMLESS = ["cost an array", "cost a tensor", "success an array", "trace of numbers"]


def guarded(fault: str, factory: str = "make") -> GuardedSkill:
    return GuardedSkill(load_skill(f"faulty:{factory}", SkillOptions(launcher=fault)))


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_trial_is_a_failed_trial_with_its_reason(fault: str) -> None:
    skill, rng = guarded(fault), np.random.default_rng(0)
    results = []
    for _ in range(2 * MOST_FAULTS):
        skill.reset(rng)
        results.append(skill.execute(np.zeros(2)))
    for number, result in enumerate(results, 1):
        assert result.executed == (number % 3 != 0)
        if result.executed:
            assert result.cost is not None
        else:
            assert (result.cost, result.success, result.outcome) == (None, False, None)
            assert result.info["reason"].startswith("error: ")
            assert result.info["outcomes"] == {"near": False, "exact": False}
            assert "\n" not in result.info["error"]


@pytest.mark.parametrize("fault", HARMLESS)
def test_numbers_of_another_kind_are_numbers(fault: str) -> None:
    skill, plain = guarded(fault, "make_always"), load_skill("reaching:make", SkillOptions())
    for player in (skill, plain):
        player.reset(np.random.default_rng(1))
    result, expected = skill.execute(np.zeros(2)), plain.execute(np.zeros(2))
    assert (result.cost, result.success, result.executed) == (expected.cost, expected.success, True)
    assert type(result.cost) is float


def test_ten_faults_in_a_row_are_the_end() -> None:
    skill = guarded("raises", "make_always")
    for _ in range(MOST_FAULTS - 1):
        assert not skill.execute(np.zeros(2)).executed
    with pytest.raises(
        SkillFault, match=r"execute failed 10 times in a row: RuntimeError: joint 3 stalled at 0.2 rad .faulty"
    ):
        skill.execute(np.zeros(2))


@pytest.mark.parametrize(
    ("fault", "complaint"),
    [
        ("reset raises", r"reset: IndexError"),
        ("reset too long", r"reset: Invalid: the state must have shape \(2,\); got \(3,\)"),
        ("reset nan", r"reset: Invalid: the state must be finite"),
        ("reset nothing", r"reset: Invalid: the state must have shape"),
        ("spec raises", r"spec: KeyError: 'goal'"),
        ("spec a map", r"spec must return a TaskSpec; got dict"),
        ("demonstrations raises", r"demonstrations: ZeroDivisionError"),
        ("demonstrations a pair", r"demonstrations: TypeError: demonstration 0 must be a Demonstration; got tuple"),
    ],
)
def test_another_fault_says_where_it_is(fault: str, complaint: str) -> None:
    skill = guarded(fault)
    with pytest.raises(SkillFault, match=complaint):
        _ = skill.spec(), skill.reset(np.random.default_rng(0)), skill.demonstrations(2, np.random.default_rng(0))


@pytest.mark.parametrize("fault", ["scene raises", "scene of numbers"])
def test_shapes_that_cannot_be_drawn_are_left_out(fault: str) -> None:
    assert guarded(fault).scene() == []


@pytest.fixture
def train(start_command: Start, task: Task, shared_endpoint: str) -> Start:
    """Starts two workers of a skill with a fault."""

    def start(factory: str, fault: str) -> Any:
        words = ["--task", task.name, "--connect", shared_endpoint, "--json", "-n", "2", "--trials", "60"]
        return start_command("workers", f"faulty:{factory}", "--launcher", fault, *words, "--evaluations", "10")

    return start


def test_workers_go_on_after_faults_and_meet_the_total(train: Start, task: Task) -> None:
    result = train("make", "raises").result()
    assert (result["workers_lost"], result["trained"]) == (0, 60)
    kinds = Counter(stored.trial.kind for stored in task.iter_samples())
    assert kinds["trial"] + kinds["failed"] == 60
    assert 15 <= kinds["failed"] <= 25
    reasons = {stored.trial.info["reason"] for stored in task.iter_samples() if stored.trial.kind == "failed"}
    assert "error: RuntimeError" in reasons


@pytest.mark.parametrize(
    ("factory", "fault", "complaint"),
    [
        ("make_always", "raises", "all workers are lost; the last one said: Faulty.execute failed 10 times in a row"),
        ("make", "spec raises", "error: Faulty.spec: KeyError: 'goal'"),
        (
            "make",
            "demonstrations raises",
            "error: Faulty.demonstrations: ZeroDivisionError: division by zero (faulty.py",
        ),
    ],
)
def test_a_skill_that_is_of_no_use_ends_the_run_with_one_line(
    train: Start, factory: str, fault: str, complaint: str
) -> None:
    status, _, log = train(factory, fault).finish()
    assert status == 1
    assert "Traceback" not in log
    assert complaint in log.splitlines()[-1]


def test_a_skill_may_print_change_folder_and_start_threads(train: Start, task: Task) -> None:
    command = train("make_loud", "")
    status, output, log = command.finish()
    assert status == 0, log
    assert json.loads(output)["trained"] == 60
    assert "swing" in log
    assert os.getcwd() != "/"


def test_a_planner_that_raises_is_one_line(start_command: Start) -> None:
    words = ("oracle", "--skill", "faulty:make", "--launcher", "best_plan raises", "--balls", "4", "--jobs", "1")
    status, _, log = start_command(*words).finish()
    assert status == 1
    assert log.splitlines()[-1].startswith("error: Faulty.best_plan: LookupError: no plan (faulty.py, line ")
    assert "Traceback" not in log


def test_a_policy_of_a_skill_that_always_raises_is_not_judged(
    train: Start, start_command: Start, task: Task, shared_endpoint: str
) -> None:
    train("make", "").result()
    words = ("--skill", "faulty:make_always", "--launcher", "raises", "--balls", "30", "--jobs", "1", "--no-oracle")
    status, _, log = start_command("evaluate", task.name, *words, "--connect", shared_endpoint).finish()
    assert status == 1
    assert "failed 10 times in a row" in log.splitlines()[-1]
    assert "Traceback" not in log


def test_a_skill_of_three_methods_lacks_demonstrations_and_scene() -> None:
    bare, whole = (GuardedSkill(load_skill(f"reaching:{make}", SkillOptions())) for make in ("make_bare", "make"))
    assert (whole.can_demonstrate, list(whole.lacks)) == (True, [])
    assert not bare.can_demonstrate
    assert [line.partition(":")[0] for line in bare.lacks] == ["no demonstrations", "no scene"]
    assert list(bare.scene()) == []
    with pytest.raises(SkillFault, match="Bare has no demonstrations"):
        bare.demonstrations(1, np.random.default_rng(0))
