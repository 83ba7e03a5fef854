"""A worker that judges epochs, on a real server, beside another one."""

from dataclasses import replace
from multiprocessing import Pipe
from typing import Any

import pytest

from crkr.client import Client, Task
from crkr.sim_worker import SkillOptions, load_skill
from crkr.sim_worker.evaluation.contexts import EpochEvaluation, FixedContexts
from crkr.sim_worker.evaluation.evaluator import Evaluator
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.randomness import demonstration_rng
from crkr.sim_worker.supervisor.child_process import MessagePipe
from crkr.sim_worker.supervisor.task_setup import record_demonstrations
from crkr.sim_worker.worker.supervisor_link import SupervisorLink
from crkr.sim_worker.worker.telemetry import Telemetry

pytestmark = pytest.mark.usefixtures("skills_here")
COUNT = 4


@pytest.fixture
def skill(task: Task) -> GuardedSkill:
    return GuardedSkill(load_skill("reaching:make", SkillOptions(name=task.name)))


@pytest.fixture
def ready(client: Client, skill: GuardedSkill) -> Task:
    """The test's task with its demonstrations."""
    created = client.create_task(skill.spec())
    record_demonstrations(created, skill, 5, demonstration_rng(1), "demonstrator")
    return created


def examined(task: Task, skill: GuardedSkill) -> EpochEvaluation:
    """Epoch 0 as another worker plays it."""
    contexts = FixedContexts(skill, task.spec.seed, COUNT)
    evaluation = EpochEvaluation(task, contexts, 0, 0, task.predict(contexts.states), "other")
    while not evaluation.finished:
        evaluation.play_next()
    return evaluation


def evaluated(task: Task, skill: GuardedSkill) -> list[dict[str, Any]]:
    """What a worker tells its supervisor about epoch 0."""
    ours, theirs = Pipe()
    with ours, theirs:
        evaluator = Evaluator(task, skill, COUNT, "worker", SupervisorLink(MessagePipe(ours), 5.0), Telemetry(task, ()))
        evaluator.judge(0, 0)
        evaluator.finish(5.0)
        supervisor, events = MessagePipe(theirs), []
        while (event := supervisor.receive(0.0)) is not None:
            events.append(event)
    return [event for event in events if event["event"] == "evaluated"]


def test_the_rates_it_tells_are_those_of_the_log(ready: Task, skill: GuardedSkill) -> None:
    (event,) = evaluated(ready, skill)
    stored = [each.trial.info["outcomes"] for each in ready.iter_samples() if each.trial.kind == "evaluation"]
    assert len(stored) == COUNT
    assert event["rates"] == {name: sum(marks[name] for marks in stored) / COUNT for name in ("near", "exact")}


def test_it_tells_no_rates_of_an_epoch_that_another_worker_has_judged(ready: Task, skill: GuardedSkill) -> None:
    others = [replace(trial, cost=0.5) for trial in examined(ready, skill).trials]
    ready.report_trials(others)
    assert evaluated(ready, skill) == [{"event": "evaluated", "epoch": 0, "rates": None}]
    stored = [each.trial for each in ready.iter_samples() if each.trial.kind == "evaluation"]
    assert [trial.cost for trial in stored] == [0.5] * COUNT


def test_an_epoch_without_a_model_is_passed_over(client: Client, skill: GuardedSkill) -> None:
    created = client.create_task(skill.spec())
    assert evaluated(created, skill) == [{"event": "evaluated", "epoch": 0, "rates": None}]
