"""A worker that judges epochs, on a real server, beside another one."""

from dataclasses import replace
from multiprocessing import Pipe
from typing import Any

import pytest

from crkr.client import Client, Task
from crkr.sim_worker import Skill, SkillOptions, load_skill
from crkr.sim_worker.evaluation.contexts import Examination, FixedContexts
from crkr.sim_worker.evaluation.evaluator import Evaluator
from crkr.sim_worker.randomness import demonstration_rng
from crkr.sim_worker.supervisor.demonstrations import record_demonstrations
from crkr.sim_worker.supervisor.pipe import Line
from crkr.sim_worker.worker.supervisor_link import Orders
from crkr.sim_worker.worker.telemetry import Telemetry

pytestmark = pytest.mark.usefixtures("skills_here")
COUNT = 4


@pytest.fixture
def skill(task: Task) -> Skill:
    return load_skill("reaching:make", SkillOptions(name=task.name))


@pytest.fixture
def ready(client: Client, skill: Skill) -> Task:
    """The test's task with its demonstrations."""
    created = client.create_task(skill.spec())
    record_demonstrations(created, skill, 5, demonstration_rng(1), "demonstrator")
    return created


def examined(task: Task, skill: Skill) -> Examination:
    """Epoch 0 as another worker plays it."""
    contexts = FixedContexts(skill, task.spec.seed, COUNT)
    examination = Examination(task, contexts, 0, 0, task.predict(contexts.states), "other")
    while not examination.finished:
        examination.play_next()
    return examination


def evaluated(task: Task, skill: Skill) -> list[dict[str, Any]]:
    """What a worker tells its launcher about epoch 0."""
    ours, theirs = Pipe()
    with ours, theirs:
        evaluator = Evaluator(task, skill, COUNT, "worker", Orders(Line(ours), 5.0), Telemetry(task, ()))
        evaluator.judge(0, 0)
        evaluator.finish(5.0)
        launcher, events = Line(theirs), []
        while (event := launcher.receive(0.0)) is not None:
            events.append(event)
    return [event for event in events if event["event"] == "evaluated"]


def test_the_rates_it_tells_are_those_of_the_log(ready: Task, skill: Skill) -> None:
    (event,) = evaluated(ready, skill)
    stored = [each.trial.info["outcomes"] for each in ready.iter_samples() if each.trial.kind == "evaluation"]
    assert len(stored) == COUNT
    assert event["rates"] == {name: sum(marks[name] for marks in stored) / COUNT for name in ("near", "exact")}


def test_it_tells_no_rates_of_an_epoch_that_another_worker_has_judged_otherwise(ready: Task, skill: Skill) -> None:
    others = [replace(trial, cost=0.5) for trial in examined(ready, skill).trials]
    ready.report_trials(others)
    assert evaluated(ready, skill) == [{"event": "evaluated", "epoch": 0, "rates": None}]
    stored = [each.trial for each in ready.iter_samples() if each.trial.kind == "evaluation"]
    assert [trial.cost for trial in stored] == [0.5] * COUNT
