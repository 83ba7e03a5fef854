"""Tasks that hold all that may wait for learning do not keep the others out, and together hold a bounded amount.

What would wait for long is refused at once.
"""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest

from crkr.learner import Model
from crkr.protocol import Busy, CrkrError, TaskSpec, Trial
from crkr.server.learning.fit import Fitting
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.log import LoggedTrial, SqliteLog
from crkr.server.metrics.durations import Latencies
from crkr.server.verbs.read import Reader
from crkr.server.verbs.report import Writer
from crkr.server.workers import Workers

MIB = 2**20
PATIENCE_S = 30.0
SLOW = [f"slow-{number}" for number in range(20)]


class Asked:
    """A request that the test makes, and keeps the answer of."""

    client, received, deadline, left = b"", 0.0, math.inf, 0.0

    def __init__(self, verb: str, task: str, message: dict[str, Any], size: int = 1000, spends_s: float = 0.0) -> None:
        self.verb, self.task, self.size = verb, task, size
        self.answered = self.held = False
        self.code = ""
        self._message, self._spends_s, self._told = message, spends_s, threading.Event()

    def wait(self) -> str:
        """The answer's code, when it is there."""
        assert self._told.wait(PATIENCE_S)
        return self.code

    def message(self) -> dict[str, Any]:
        return self._message

    def reply(self, _message: Mapping[str, Any]) -> None:
        until = time.monotonic() + self._spends_s
        while time.monotonic() < until:
            pass  # it takes that long on any machine
        self.answered, self.code = True, "OK"
        self._told.set()

    def fail(self, error: CrkrError) -> None:
        self.answered, self.code = True, error.code
        self._told.set()

    def fail_unexpectedly(self, error: BaseException) -> None:
        assert isinstance(error, CrkrError), error
        self.fail(error)


class Server:
    """Stores what is reported, and learns nothing before it is told to, as if every task were very slow."""

    def __init__(self, log: SqliteLog, reach: dict[str, Any], trial: Callable[[int], dict[str, Any]]) -> None:
        def ignore(_task: ServedTask, _before: Model | None = None, _after: Model | None = None) -> None:
            """Publishes no new models."""

        self.learning = Learning(ignore, ignore, lambda _: None)
        self.tasks, self._trial, self._count = Tasks(), trial, 0
        for name in ("reach", *SLOW):
            self.tasks.add(ServedTask(TaskSpec.from_dict({**reach, "name": name})))
            log.create(self.tasks.get(name).created)
        workers, latencies = Workers(), Latencies()
        self._writer: Any = Writer(log, self.tasks, workers, self.learning)
        self._reader: Any = Reader(
            uuid4(), self.tasks, log.reads, self.learning, workers, latencies, dict, list, lambda _: {}
        )
        self._fitting: Any = Fitting(self.tasks, self.learning, self._writer)

    def report(
        self, task: str, *, wait: bool = False, size: int = 1000, count: int = 1, spends_s: float = 0.0
    ) -> Asked:
        trials = [self._trial(self._count + number) for number in range(count)]
        self._count += count
        report = Asked("report", task, {"trials": trials, "wait": wait}, size, spends_s)
        self._writer.store([report])
        return report

    def configure(self, task: str, budget: int) -> Asked:
        change = Asked("configure", task, {"changes": {"budget": budget}})
        self._writer.change([change])
        return change

    def explain(self, task: str) -> Asked:
        question = Asked("explain", task, {"state": [0.5, 0.0], "sample_id": self._trial(0)["id"]})
        self._reader.work([question])
        return question

    def refit(self, task: str) -> None:
        self._fitting.work([Asked("refit", task, {})])

    def add(self, name: str, trials: int) -> None:
        """Stored trials, which wait to be learned."""
        task = self.tasks.get(name)
        one = Trial.create(task.spec, id=UUID(int=1), state=[0.1] * 2, goal=[0.2] * 3, cost=0.1, success=True)
        self.learning.submit(task, [LoggedTrial(2, 0.0, one)] * trials)


@pytest.fixture
def server(tmp_path: Path, reach: dict[str, Any], make_trial: Callable[[int], dict[str, Any]]) -> Iterator[Server]:
    log = SqliteLog(tmp_path)
    made = Server(log, reach, make_trial)
    yield made
    made.learning.close(0.0)
    log.close()


def test_tasks_with_many_trials_to_learn_are_refused_and_others_are_not(server: Server) -> None:
    for name in SLOW[:6]:
        server.add(name, 20_000)
    assert [server.report(name).code for name in SLOW[:6]] == ["BUSY"] * 6
    assert server.report("reach").code == "OK"
    server.add(SLOW[6], 6000)
    assert server.report(SLOW[6]).code == "OK"
    server.add(SLOW[6], 1000)  # over a sixteenth of the common limit: there are eight such tasks
    assert server.report(SLOW[6]).code == "BUSY"
    assert server.report("reach").code == "OK"
    for name in SLOW[7:12]:
        server.add(name, 20_000)
    assert server.report("reach").code == "BUSY"  # memory has an end


def test_tasks_with_large_requests_that_wait_leave_room_for_others(server: Server) -> None:
    def codes(task: str, number: int, size: int) -> Counter[str]:
        return Counter(server.report(task, wait=True, size=size).code for _ in range(number))

    assert codes("reach", 1, 40 * MIB) == {"": 1}  # the first of a task may have any size
    assert codes("reach", 1, 1000) == {"BUSY": 1}
    assert codes(SLOW[0], 4, 5 * MIB) == {"": 3, "BUSY": 1}
    assert codes(SLOW[1], 3, 5 * MIB) == {"": 2, "BUSY": 1}  # three tasks share half of 64 MiB
    assert codes(SLOW[2], 1, 11 * MIB) == {"BUSY": 1}
    assert codes(SLOW[2], 9, MIB) == {"": 8, "BUSY": 1}
    assert codes(SLOW[3], 1, 1000) == {"": 1}
    assert server.report("reach").code == "OK"  # nobody waits for this one


def test_tasks_for_which_many_requests_wait_leave_room_for_others(server: Server) -> None:
    for name in SLOW[:8]:
        for _ in range(1024):
            server.learning.submit(server.tasks.get(name), (), lambda *_: None)
        if name == SLOW[4]:
            assert server.report(SLOW[5], wait=True).code == ""
    assert server.report(SLOW[0], wait=True).code == "BUSY"
    assert server.report("reach", wait=True).code == "BUSY"  # twice the limit of all
    assert server.report("reach").code == "OK"


def test_what_would_wait_long_for_trials_that_nobody_waits_for_is_refused_at_once(server: Server) -> None:
    task, learning = server.tasks.get("reach"), server.learning
    over = threading.Event()

    def lasts(_result: Any, _failure: Exception | None) -> None:
        over.wait(PATIENCE_S)

    learning.start()
    assert server.report("reach", wait=True, spends_s=0.06).wait() == "OK"  # so long is a step, or longer
    learning.submit(task, (), lasts)
    try:
        few = [server.explain("reach"), server.configure("reach", 5), server.report("reach", wait=True)]
        few.append(server.explain("reach"))  # a step of trials waits, which it joins
        assert [asked.code for asked in few] == [""] * 4
        for _ in range(40):
            assert server.report("reach", count=64).code == "OK"
        refused = [server.report("reach", wait=True), server.configure("reach", 6), server.explain("reach")]
        assert [asked.code for asked in refused] == ["BUSY"] * 3
        with pytest.raises(Busy):
            server.refit("reach")
        assert server.report(SLOW[0], wait=True).wait() == "OK"
    finally:
        over.set()
    assert [asked.wait() for asked in few] == ["OK"] * 4
    learned = threading.Event()
    learning.submit(task, (), lambda *_: learned.set())
    assert learned.wait(PATIENCE_S)
    assert server.report("reach", wait=True).wait() == "OK"
    assert (task.spec.budget, task.eligible) == (5, 2 + 40 * 64 + 1)
