"""The trial loop beside others that draw the same situations."""

from collections.abc import Iterator
from multiprocessing import Pipe

import pytest

from crkr.client import Client, Task
from crkr.protocol import Trial
from crkr.sim_worker import SkillOptions, load_skill
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.randomness import demonstration_rng, training_rng
from crkr.sim_worker.supervisor.child_process import MessagePipe
from crkr.sim_worker.supervisor.task_setup import record_demonstrations
from crkr.sim_worker.worker.supervisor_link import SupervisorLink
from crkr.sim_worker.worker.telemetry import Telemetry
from crkr.sim_worker.worker.trial_loop import Identity, TrialLoop

pytestmark = pytest.mark.usefixtures("skills_here")
SEED, FIRST_SEQ = 7, 6


@pytest.fixture
def link() -> Iterator[SupervisorLink]:
    """A link whose supervisor sends no order."""
    ours, theirs = Pipe()
    with ours, theirs:
        yield SupervisorLink(MessagePipe(ours), 5.0)


def first_trial(task: Task, link: SupervisorLink, worker: str) -> Trial:
    """The first trial of a worker, which it stores; the model learns nothing from it, so that goals stay the same."""
    skill = load_skill("reaching:make_unmoved", SkillOptions(name=task.name))
    return TrialLoop(task, skill, Identity(worker, SEED, FIRST_SEQ), link, Telemetry(task, ())).run_one()


@pytest.fixture
def ready(task: Task, client: Client) -> Task:
    """The test's task with its demonstrations."""
    skill = GuardedSkill(load_skill("reaching:make", SkillOptions(name=task.name)))
    created = client.create_task(skill.spec())
    record_demonstrations(created, skill, 5, demonstration_rng(SEED), "demonstrator")
    return created


def stored(task: Task) -> list[Trial]:
    return [each.trial for each in task.iter_samples() if each.trial.kind in ("trial", "failed")]


def test_the_trial_that_another_worker_has_stored_is_done_anew_in_another_situation(
    ready: Task, link: SupervisorLink
) -> None:
    theirs = first_trial(ready, link, "one")
    mine = first_trial(ready, link, "two")
    assert mine.id != theirs.id
    assert (mine.state != theirs.state).any()
    assert [(trial.id, trial.worker) for trial in stored(ready)] == [(theirs.id, "one"), (mine.id, "two")]


def test_a_duplicate_of_the_workers_own_is_its_trial(ready: Task, link: SupervisorLink) -> None:
    first = first_trial(ready, link, "one")
    again = first_trial(ready, link, "one")  # as when the answer to the first attempt was lost
    assert again.id == first.id
    assert (again.state == training_rng(SEED, FIRST_SEQ).uniform(-1.0, 1.0, 2)).all()
    assert [trial.id for trial in stored(ready)] == [first.id]
