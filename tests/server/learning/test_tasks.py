"""The tasks in service: bounded, looked up in the same time however many there are, and changed by any thread."""

from __future__ import annotations

import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

from crkr.learner import Model
from crkr.protocol import ShuttingDown, TaskSpec, UnknownTask, rpc_key
from crkr.server.learning.restore import restored
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.log import Event, SqliteLog
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.request import Request
from crkr.server.session import open_session
from crkr.server.verbs.report import Writer
from crkr.server.workers import Workers

PATIENCE_S = 60.0
MANY = 20_000


def made(name: str) -> ServedTask:
    entry: dict[str, Any] = {"name": "x", "low": -1.0, "high": 1.0}
    return ServedTask(TaskSpec.from_dict({"name": name, "state": [entry], "goal": [{**entry, "scale": 1.0}]}))


def moved(before: str, after: str | None) -> Event:
    body = {"was": before} if after is None else {"was": before, "name": after}
    return Event(2, 0.0, "delete" if after is None else "rename", body)


@pytest.fixture
def quick_switches() -> Iterator[None]:
    """Threads take turns after a few instructions, as they may on a busy machine."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.parametrize("served", [0, 2])
def test_an_unknown_name_costs_no_memory_for_each_task(served: int) -> None:
    tasks = Tasks()
    for number in range(served):
        tasks.add(made(f"task-{number}"))
    tasks.note_names(f"task-{number}" for number in range(MANY))
    tracemalloc.start()
    try:
        with pytest.raises(UnknownTask, match=f"task-0, task-1, .*task-19 and {MANY - 20} more"):
            tasks.look("nobody")
        assert tracemalloc.get_traced_memory()[1] < MANY  # a list of all would take eight times as much
    finally:
        tracemalloc.stop()
    assert len(tasks) == MANY


def test_tasks_served_here_and_elsewhere_are_listed_once_and_in_order() -> None:
    tasks = Tasks()
    for name in ("a", "b"):
        tasks.add(made(name))
    assert tasks.names() == ["a", "b"]
    tasks.note_names(["a", "c"])
    tasks.add(made("d"))
    assert tasks.names() == ["a", "c", "b", "d"]
    tasks.move("b", moved("b", "e"))
    tasks.move("d", moved("d", None))
    assert (tasks.names(), len(tasks)) == (["a", "c", "e"], 3)
    tasks.leave("a")
    for name in ("a", "c"):
        with pytest.raises(ShuttingDown):
            tasks.look(name)
    assert [task.name for task in tasks.all()] == ["b"]  # renamed by its own thread later
    tasks.note_names(())
    assert tasks.names() == ["e"]


def test_a_task_that_is_taken_while_another_is_renamed_is_served(quick_switches: None) -> None:
    tasks, taken, over = Tasks(), [made(f"task-{number}") for number in range(2000)], threading.Event()
    tasks.add(made("0"))
    tasks.note_names(["0"])

    def rename() -> None:
        number = 0
        while not over.is_set():
            tasks.move(str(number), moved(str(number), str(number + 1)))
            number += 1

    renaming = threading.Thread(target=rename)
    renaming.start()
    try:
        for task in taken:
            tasks.add(task)
    finally:
        over.set()
        renaming.join(PATIENCE_S)
    assert len(tasks.all()) == len(tasks) == len(taken) + 1
    assert all(task.name in tasks for task in taken)


def test_where_there_are_too_many_tasks_none_is_made_and_all_are_served(
    tmp_path: Path, free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    def ignore(_task: ServedTask, _before: Model | None = None, _after: Model | None = None) -> None:
        """Publishes no models."""

    endpoint, names = f"tcp/127.0.0.1:{free_port}", ["a", "b", "c"]
    tasks = Tasks(most=2)
    with closing(SqliteLog(tmp_path)) as log, open_session(endpoint, None) as session:
        for name in names:  # as of an earlier version
            log.create(made(name).created)
            tasks.add(restored(log.reads, name))
        writer = Writer(log, tasks, Workers(), Learning(ignore, ignore, ignore))
        queries = session.declare_queryable(rpc_key("create_task"), zenoh.handlers.FifoChannel(4), complete=True)
        asking = plain(endpoint)

        def create(name: str) -> Any:
            given = msgpack.packb(made(name).created.to_dict())
            replies = asking.get(
                rpc_key("create_task"), zenoh.handlers.FifoChannel(1), payload=given, timeout=PATIENCE_S
            )
            writer.change([Request(queries.recv(), Latencies())])
            reply = replies.recv()
            body = reply.ok or reply.err
            assert body is not None
            return msgpack.unpackb(body.payload.to_bytes())

        refusal = create("d")
        assert refusal["code"] == "INVALID"
        assert "crkr delete" in refusal["message"]
        assert refusal["details"] == {"most": 2}
        with pytest.raises(UnknownTask):
            log.reads.event("d", 1)
        assert tasks.names() == names
        assert create("a")["created"] is False  # it is found as before
        for name in ("a", "b"):
            tasks.move(name, moved(name, None))
        assert create("d")["created"] is True
