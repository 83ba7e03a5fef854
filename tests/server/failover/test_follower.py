"""A server that stands by has the models that a restart would find, also while another server writes."""

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from uuid import UUID

import pytest

from crkr.server.follower import Follower
from crkr.server.learning.restore import FEW, catch_up, restore_all
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import PendingReport, read_log
from crkr.server.log.postgres.log import PostgresLog

from .test_log_owners import SPEC, report


@pytest.fixture
def url(make_database: Callable[[], str]) -> str:
    return make_database()


@pytest.fixture
def log(url: str) -> Iterator[PostgresLog]:
    """The log as the server that writes to it holds it."""
    made, _ = Follower(url, "tcp/127.0.0.1:1", lambda _: None).take()
    made.keep(lambda _: None)
    yield made
    made.close()


def test_what_a_server_that_stands_by_follows_is_what_a_restart_finds(log: PostgresLog, url: str) -> None:
    reader = read_log(url)
    try:
        log.create(SPEC)
        log.append_reports(report(1))
        tasks = {task.name: task for task in restore_all(reader)}
        log.append_reports(report(2) + report(3))
        log.append_event("reach", "recost", {"ids": [UUID(int=2)], "costs": [0.25], "reason": ""})
        log.append_event("reach", "configure", {"changes": {"budget": 2}})
        catch_up(reader, tasks)
        assert_alike(tasks, restore_all(reader))
        back = {"to": 3, "ids": [], "values": [], "spec": SPEC.to_dict(), "reason": ""}
        log.append_event("reach", "rollback", back)
        log.append_event("reach", "rename", {"name": "grasp"})
        log.create(replace(SPEC, name="throw"))
        catch_up(reader, tasks)
        assert sorted(tasks) == ["grasp", "throw"]
        assert_alike(tasks, restore_all(reader))
        log.append_event("throw", "delete", {"name": "deleted/throw/1"})
        catch_up(reader, tasks)
        assert sorted(tasks) == ["grasp"]
    finally:
        reader.close()


def test_tasks_that_another_server_creates_meanwhile_are_no_damage(log: PostgresLog, url: str) -> None:
    names = [f"reach {number}" for number in range(200)]

    def create() -> None:
        for name in names:
            log.create(replace(SPEC, name=name))

    with closing(read_log(url)) as reader:
        creating = threading.Thread(target=create)
        creating.start()
        while creating.is_alive():
            assert set(reader.positions().values()) <= {1}
        creating.join()
        assert list(reader.positions()) == names


def test_what_is_restored_while_another_server_writes_lacks_no_entry(log: PostgresLog, url: str) -> None:
    reader, written = read_log(url), threading.Event()
    log.create(SPEC)
    many = [trial for number in range(1, FEW + 1000) for trial in report(number)[0].trials]
    log.append_reports([PendingReport("reach", tuple(many))])

    def write() -> None:
        for number in itertools.count(FEW + 1000):
            log.append_reports(report(number))
            if written.is_set():
                return

    writing = threading.Thread(target=write)
    writing.start()
    try:
        for _ in range(3):
            [task] = restore_all(reader)
            assert task.model.version == task.seq
    finally:
        written.set()
        writing.join(30)
        reader.close()


def assert_alike(followed: dict[str, ServedTask], restored: list[ServedTask]) -> None:
    assert {task.name for task in restored} == set(followed)
    for task in restored:
        other = followed[task.name]
        assert (other.seq, other.samples, other.spec, other.eligible) == (
            task.seq,
            task.samples,
            task.spec,
            task.eligible,
        )
        assert other.model.version == task.model.version
        assert other.model.ids == task.model.ids
