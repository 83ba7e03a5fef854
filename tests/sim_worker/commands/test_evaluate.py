"""`crkr evaluate` and `crkr oracle` against what they should find."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from crkr.client import Task
from crkr.sim_worker.randomness import fresh_rng

Start = Callable[..., Any]
CONTEXTS = 60


def evaluate(start_command: Start, endpoint: str, *words: str, task: str = "reaching") -> Any:
    options = ["--skill", "reaching:make", "--contexts", str(CONTEXTS), "--seed", "4", "--connect", endpoint, "--json"]
    options += ["--jobs", "1"]
    return start_command("evaluate", task, *options, *words)


def distances(task: Any) -> np.ndarray[Any, Any]:
    """How far the policy's goals are from the right ones in the contexts of seed 4, computed here."""
    states = np.array([fresh_rng(4, context).uniform(-1.0, 1.0, 2) for context in range(CONTEXTS)])
    turn = math.radians(30.0)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    found: np.ndarray[Any, Any] = np.linalg.norm(task.predict(states).goals - states @ rotation.T, axis=1)
    return found


def test_rates_and_intervals_are_those_of_the_policy(start_command: Start, finished_run: Any) -> None:
    result = evaluate(start_command, finished_run.endpoint, "--jobs", "2").result()
    miss = distances(finished_run.task)
    for name, reach in (("near", 0.35), ("exact", 0.0875)):
        successes = int((miss < reach).sum())
        expected = binomtest(successes, CONTEXTS).proportion_ci(0.95, "wilson")
        assert result[name] == pytest.approx(successes / CONTEXTS)
        assert result["ci95"][name] == pytest.approx([expected.low, expected.high])
    assert sum(result["reasons"].values()) == CONTEXTS
    assert (result["contexts"], result["seed"], result["recorded"]) == (CONTEXTS, 4, 0)


def test_the_planner_and_the_rate_before_learning_are_reported_too(start_command: Start, finished_run: Any) -> None:
    result = evaluate(start_command, finished_run.endpoint).result()
    assert result["oracle"] == {"near": 1.0, "exact": 1.0}
    before = finished_run.report["epochs"][0]
    assert result["before_learning"] == {"near": before["near"], "exact": before["exact"], "contexts": 10, "balls": 10}


def test_nothing_is_stored_unless_asked_for(start_command: Start, task: Task, shared_endpoint: str) -> None:
    options = ["--task", task.name, "--connect", shared_endpoint, "--evaluations", "0", "--trials", "5"]
    assert start_command("workers", "reaching:make", *options).finish()[0] == 0
    before = task.status()["samples"]
    evaluate(start_command, shared_endpoint, "--no-oracle", task=task.name).result()
    assert task.status()["samples"] == before
    result = evaluate(start_command, shared_endpoint, "--no-oracle", "--record", task=task.name).result()
    assert result["recorded"] == CONTEXTS == task.status()["samples"]["evaluation"]


def test_the_environment_that_the_skill_chooses_is_the_same_as_naming_it(
    start_command: Start, task: Task, shared_endpoint: str
) -> None:
    options = ["--task", task.name, "--connect", shared_endpoint, "--evaluations", "0", "--trials", "5"]
    assert start_command("workers", "reaching:make", *options).finish()[0] == 0
    results = [
        evaluate(start_command, shared_endpoint, "--no-oracle", "--record", *words, task=task.name).result()
        for words in ((), ("--environment", "plane"), ("--environment", "other"))
    ]
    assert [result["environment"] for result in results] == ["plane", "plane", "other"]
    assert [result["recorded"] for result in results] == [CONTEXTS, 0, CONTEXTS]


def test_a_skill_of_another_size_is_refused(start_command: Start, finished_run: Any) -> None:
    options = ["--skill", "table-tennis", "--connect", finished_run.endpoint]
    status, _, log = start_command("evaluate", "reaching", *options).finish()
    assert status == 1
    assert "the skill maps R^6 to R^13, but task 'reaching' maps R^2 to R^2" in log.splitlines()[-1]


def test_an_unknown_task_is_one_line(start_command: Start, finished_run: Any) -> None:
    options = ["--skill", "reaching:make", "--connect", finished_run.endpoint]
    status, _, log = start_command("evaluate", "other", *options).finish()
    assert status == 1
    assert log.splitlines()[-1].startswith("error: no task 'other'")


def test_the_oracle_plays_the_skills_own_planner(start_command: Start) -> None:
    result = start_command("oracle", "--skill", "reaching:make", "--contexts", "25", "--json").result()
    assert (result["near"], result["exact"], result["contexts"]) == (1.0, 1.0, 25)


def test_a_skill_may_choose_the_contexts_that_it_is_judged_in(start_command: Start) -> None:
    words = ("oracle", "--skill", "reaching:make_fixed", "--contexts", "10", "--json")
    assert start_command(*words).result()["exact"] == 0.5


def test_the_old_name_of_contexts_still_works_and_says_the_new_one(start_command: Start) -> None:
    command = start_command("oracle", "--skill", "reaching:make", "--balls", "12", "--json")
    result = command.result()
    assert result["contexts"] == result["balls"] == 12
    assert "warning: --balls is now called --contexts" in command.log.read_text()
