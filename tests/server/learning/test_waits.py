"""Nobody is let in to wait for learning longer than callers wait: what would take that long is BUSY at once."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

from crkr.learner import Model
from crkr.protocol import TaskSpec
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.learning.waits import Waits
from crkr.server.log import SqliteLog
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.request import Request
from crkr.server.session import open_session
from crkr.server.verbs.report import Writer
from crkr.server.workers import Workers

Done = Callable[[Any, Exception | None], None]


class Clock:
    """A clock that stands still until it is put forward."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def waiting(waits: Waits, task: str, count: int) -> list[Done]:
    """That many waiting requests; calling one answers it."""
    return [waits.timed(task, lambda _result, _failure: None) for _ in range(count)]


def test_one_more_waits_as_long_as_all_before_it_and_no_longer_than_two_seconds(clock: Clock) -> None:
    waits = Waits(clock)
    first, *others = waiting(waits, "slow", 20)
    clock.now = 0.09
    first(None, None)  # a step takes 90 ms, so that 19 more take 1.7 s, and 23 would take over 2 s
    assert not waits.too_long("slow")
    others += waiting(waits, "slow", 4)
    assert waits.too_long("slow")
    assert not waits.too_long("another")
    clock.now += 0.001 * len(others)
    for done in others[:20]:  # it has become quicker
        done(None, None)
    waiting(waits, "slow", 30)
    assert not waits.too_long("slow")


def test_a_few_may_always_wait_and_not_many_before_the_first_was_answered(clock: Clock) -> None:
    waits = Waits(clock)
    first, *_ = waiting(waits, "new", 7)
    clock.now = 60.0
    first(None, None)
    assert not waits.too_long("new")
    waiting(waits, "new", 2)
    assert waits.too_long("new")
    waiting(waits, "untried", 63)
    assert not waits.too_long("untried")
    waiting(waits, "untried", 1)
    assert waits.too_long("untried")


def test_nothing_is_kept_of_a_task_for_which_nobody_waits(clock: Clock) -> None:
    waits = Waits(clock)
    told = []
    waits.timed("task", lambda result, failure: told.append((result, failure)))("found", None)
    assert told == [("found", None)]
    assert len(waits) == 0


@pytest.fixture
def log(tmp_path: Path) -> Iterator[SqliteLog]:
    made = SqliteLog(tmp_path)
    yield made
    made.close()


def test_changes_that_would_wait_for_long_are_refused_and_those_that_were_taken_are_answered(
    log: SqliteLog, reach: dict[str, Any], free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    def ignore(_task: ServedTask, _before: Model | None = None, _after: Model | None = None) -> None:
        """Publishes no new models."""

    tasks, learning = Tasks(), Learning(ignore, ignore, lambda _: None)
    for name in ("reach", "other"):
        tasks.add(ServedTask(TaskSpec.from_dict({**reach, "name": name})))
        log.create(tasks.get(name).created)
    writer = Writer(log, tasks, Workers(), learning)
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable("crkr/@v1/task/*/admin/*", zenoh.handlers.FifoChannel(8), complete=True)
        asking = plain(endpoint)

        def ask(task: str, budget: int) -> Any:
            replies = asking.get(
                f"crkr/@v1/task/{task}/admin/configure",
                zenoh.handlers.FifoChannel(1),
                payload=msgpack.packb({"changes": {"budget": budget}}),
                timeout=30.0,
            )
            writer.change([Request(queries.recv(), Latencies())])
            return replies

        def code(replies: Any) -> str:
            reply = replies.recv()
            return "OK" if reply.ok is not None else msgpack.unpackb(reply.err.payload.to_bytes())["code"]

        asked = [ask("reach", 5 + number) for number in range(100)]  # nothing is learned meanwhile
        another = ask("other", 5)  # whose changes do not wait for those
        learning.start()
        assert Counter(map(code, asked)) == {"OK": 64, "BUSY": 36}
        assert code(another) == "OK"
        assert learning.close(5.0)
    assert tasks.get("reach").seq == 65
