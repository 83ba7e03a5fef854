"""A server that stands by takes over: nothing that was acknowledged is lost, nothing is stored twice."""

import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Any
from uuid import UUID

import pytest
from postgres import Postgres

from crkr.client import Client, Task
from crkr.server.log import LoggedTrial, read_log

Processes = Any


def check_log(url: str, acknowledged: list[Any]) -> None:
    """Every acknowledged trial is there once, no task's log has a gap, and log and model agree."""
    stored: list[UUID] = []
    reader = read_log(url)
    try:
        for name in reader.tasks():
            entries = list(reader.read(name))
            assert [entry.seq for entry in entries] == list(range(1, len(entries) + 1))
            stored += [entry.trial.id for entry in entries if isinstance(entry, LoggedTrial)]
    finally:
        reader.close()
    assert len(stored) == len(set(stored))
    assert set(acknowledged) <= set(stored)
    words = [sys.executable, "-m", "crkr.client", "replay", url]
    done = subprocess.run(words, capture_output=True, text=True, timeout=100, check=False)
    assert "agree" in done.stdout, done.stderr


def server_id(endpoints: str) -> UUID:
    with Client(endpoints, timeout_s=60) as client:
        return client.server_id()


def test_the_log_goes_from_server_to_server_under_load(
    pair: Any, reporters: Any, task: Task, processes: Processes
) -> None:
    hand_over(pair, reporters, task, processes, (signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM))


def test_a_server_that_is_killed_while_it_takes_over_loses_nothing(
    pair: Any, reporters: Any, postgres: Postgres, processes: Processes
) -> None:
    owner, other = pair.members
    processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > 30)
    database = pair.url.rpartition("/")[2]
    taken = "SELECT epoch FROM crkr.task"
    before = postgres.execute(database, taken)
    owner.send(signal.SIGKILL)
    processes.wait_until(lambda: postgres.execute(database, taken) != before, other.log)
    other.send(signal.SIGKILL)
    reached = len(reporters.acknowledged)
    for member in pair.members:
        member.start()
    processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 30)
    reporters.end()
    assert reporters.failed == []
    check_log(pair.url, reporters.acknowledged)


@pytest.mark.campaign
@pytest.mark.timeout(3000)
def test_a_hundred_owners_in_turn(
    pair: Any, reporters: Any, task: Task, processes: Processes, postgres: Postgres
) -> None:
    for turn in range(10):
        ways = (signal.SIGKILL, signal.SIGSTOP) * 5
        hand_over(pair, reporters, task, processes, ways[turn % 2 :] + ways[: turn % 2])
        postgres.stop(signal.SIGQUIT if turn % 2 else signal.SIGINT)
        postgres.start()


def hand_over(pair: Any, reporters: Any, task: Task, processes: Processes, ways: Sequence[signal.Signals]) -> None:
    """End the owner in each way, and let it stand by after that; clients ask all the while."""
    log_id, before = server_id(pair.endpoints), 0
    for how in ways:
        processes.wait_until(lambda: sum(owns(member) for member in pair.members) == 1)
        owner, other = sorted(pair.members, key=owns, reverse=True)
        reached = len(reporters.acknowledged)
        processes.wait_until(lambda reached=reached: reporters.failed or len(reporters.acknowledged) > reached + 30)
        version = task.predict([0.1, 0.2]).model_version
        assert version > before
        owner.send(how)
        processes.wait_until(lambda other=other: owns(other), other.log)
        before = task.predict([0.1, 0.2]).model_version
        assert before >= version
        if how == signal.SIGSTOP:
            owner.send(signal.SIGCONT)
        else:
            owner.start()
        processes.wait_until(lambda owner=owner: stands_by(owner), owner.log)
    assert server_id(pair.endpoints) == log_id  # clients know the log, not the server
    check_log(pair.url, list(reporters.acknowledged))
    assert reporters.failed == []


def owns(member: Any) -> bool:
    """Whether it said last that it listens."""
    return last_words(member).rfind("listening on") > last_words(member).rfind("standing by")


def stands_by(member: Any) -> bool:
    """Whether it said last that it stands by."""
    return last_words(member).rfind("listening on") < last_words(member).rfind("standing by")


def last_words(member: Any) -> str:
    return str(member.log.read_text())
