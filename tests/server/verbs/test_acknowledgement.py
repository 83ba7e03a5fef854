"""What is committed is learned, or its task says that it learns no more, whatever fails on the way to the answer."""

import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from crkr.learner import Model
from crkr.protocol import CrkrError, TaskSpec
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.log import SqliteLog
from crkr.server.verbs.admin import Change
from crkr.server.verbs.report import Writer
from crkr.server.workers import Workers

STOPPED = "learns no more until a restart"


class Panic(BaseException):
    """As a binding raises it: no `except Exception` catches it."""


class Starved(Counter[str]):
    """Counts nothing, as there is no memory."""

    def __setitem__(self, _key: str, _value: int) -> None:
        raise MemoryError


class Job:
    """A request that the test makes, and keeps the answer of."""

    verb, size = "report", 100
    client, received, deadline, left = b"", 0.0, math.inf, 0.0

    def __init__(self, task: str, *trials: dict[str, Any], wait: bool = False, fault: BaseException | None = None):
        self.task = task
        self.answered = self.held = False
        self.told = ""
        self._message, self._fault = {"trials": [*trials], "wait": wait}, fault

    def message(self) -> dict[str, Any]:
        return self._message

    def reply(self, message: Mapping[str, Any]) -> None:
        if self._fault is not None:
            raise self._fault
        self.answered, self.told = True, f"{message['accepted']} new"

    def fail(self, error: CrkrError) -> None:
        self.fail_unexpectedly(error)

    def fail_unexpectedly(self, error: BaseException) -> None:
        if not self.answered:
            self.answered, self.told = True, f"{type(error).__name__}: {error}"


@pytest.fixture
def tasks(reach: dict[str, Any]) -> Tasks:
    made = Tasks()
    for name in ("reach", "other"):
        made.add(ServedTask(TaskSpec.from_dict({**reach, "name": name})))
    return made


@pytest.fixture
def learning() -> Learning:
    def ignore(_task: ServedTask, _before: Model | None = None, _after: Model | None = None) -> None:
        """Publishes no new models."""

    return Learning(ignore, ignore, lambda _: None)


@pytest.fixture
def writer(tmp_path: Path, tasks: Tasks, learning: Learning) -> Iterator[Any]:
    log = SqliteLog(tmp_path)
    for task in tasks.all():
        log.create(task.created)
    learning.start()
    yield Writer(log, tasks, Workers(), learning)
    learning.close(0.0)
    log.close()


@pytest.fixture
def trial(make_trial: Callable[..., dict[str, Any]]) -> Callable[[int], dict[str, Any]]:
    return lambda number: make_trial(number, worker="ada")


@pytest.mark.parametrize("wait", [False, True], ids=["at once", "once learned"])
@pytest.mark.parametrize("fault", [MemoryError(), Panic()], ids=lambda fault: type(fault).__name__)
def test_a_report_whose_answer_fails_is_learned_and_so_are_those_behind_it(
    fault: BaseException,
    wait: bool,
    writer: Any,
    tasks: Tasks,
    learning: Learning,
    trial: Callable[[int], dict[str, Any]],
) -> None:
    jobs = [Job("reach", trial(number), wait=wait, fault=fault if number == 1 else None) for number in range(4)]
    writer.store(jobs)
    again = [Job("reach", trial(number)) for number in range(4)]
    writer.store(again)
    assert [job.told for job in again] == ["0 new"] * 4
    writer.store([Job("reach", trial(9), wait=True)])
    assert learning.close(30.0)
    assert [job.told for job in jobs if job is not jobs[1]] == ["1 new"] * 3
    task = tasks.get("reach")
    assert (task.fault, task.seq, task.model.version, task.eligible) == ("", 6, 6, 5)


def test_a_task_whose_trials_cannot_be_counted_or_queued_says_so_and_others_learn(
    writer: Any, tasks: Tasks, learning: Learning, trial: Callable[[int], dict[str, Any]]
) -> None:
    task, other = tasks.get("reach"), tasks.get("other")
    task.samples = Starved()
    behind, waits = Job("other", trial(1), wait=True), Job("reach", trial(2), wait=True)
    writer.store([Job("reach", trial(0)), behind, waits])
    task.samples = Counter()
    learned = threading.Event()
    learning.submit(other, (), lambda *_: learned.set())
    assert learned.wait(30.0)
    other.rests = ()  # type: ignore[assignment]  # so that no trial can be queued that nobody waits for
    writer.store([Job("other", trial(3))])
    other.rests = 0.0, None
    after = Job("other", trial(4), wait=True)
    writer.store([after])
    assert learning.close(30.0)
    assert behind.told == "1 new"
    assert STOPPED in waits.told
    assert "MemoryError" in waits.told
    assert STOPPED in after.told
    assert "IndexError" in other.fault
    assert (task.model.version, other.model.version) == (1, 2)  # a restart reads the others


def test_a_task_whose_change_cannot_be_noted_says_so(
    writer: Any, tasks: Tasks, learning: Learning, trial: Callable[[int], dict[str, Any]]
) -> None:
    task = tasks.get("reach")
    agreed, task.agreed = task.agreed, None  # type: ignore[assignment]  # which the change would be noted in
    job = Job("reach")
    writer.commit(task, Change("configure", {"changes": {"budget": 5}}, lambda *_: {"accepted": 0}), job)
    task.agreed = agreed
    after = Job("reach", trial(1), wait=True)
    writer.store([after])
    assert learning.close(30.0)
    assert STOPPED in job.told
    assert STOPPED in after.told
    assert (task.model.version, task.spec.budget) == (1, agreed.budget)
