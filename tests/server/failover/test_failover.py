"""A server that stands by takes over: nothing that was acknowledged is lost, nothing is stored twice."""

import signal
import subprocess
import sys
from typing import Any
from uuid import UUID

import pytest

from crkr.client import Client, Task
from crkr.server.log import LoggedTrial, read_log

Processes = Any


def check_log(url: str, acknowledged: list[Any]) -> None:
    """Every acknowledged trial is there once, the log has no gap, and log and model agree."""
    reader = read_log(url)
    try:
        entries = list(reader.read("reach"))
    finally:
        reader.close()
    assert [entry.seq for entry in entries] == list(range(1, len(entries) + 1))
    stored = [entry.trial.id for entry in entries if isinstance(entry, LoggedTrial)]
    assert len(stored) == len(set(stored))
    assert set(acknowledged) <= set(stored)
    words = [sys.executable, "-m", "crkr.client", "replay", url]
    done = subprocess.run(words, capture_output=True, text=True, timeout=100, check=False)
    assert "agree" in done.stdout, done.stderr


def server_id(endpoints: str) -> UUID:
    with Client(endpoints, timeout_s=60) as client:
        return client.server_id()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_the_server_that_stands_by_takes_over_under_load(
    how: signal.Signals, pair: Any, reporters: Any, task: Task, processes: Processes
) -> None:
    first, second = pair.members
    processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > 60)
    before, log_id = task.predict([0.1, 0.2]).model_version, server_id(pair.endpoints)
    first.send(how)
    processes.wait_until(lambda: second.says("listening on"), second.log)
    reached = len(reporters.acknowledged)
    processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 60)
    assert task.predict([0.1, 0.2]).model_version > before
    assert server_id(pair.endpoints) == log_id  # clients know the log, not the server
    if how == signal.SIGSTOP:
        first.send(signal.SIGCONT)
        processes.wait_until(lambda: first.says("standing by"), first.log)
    else:
        first.start()
        processes.wait_until(lambda: first.says("standing by"), first.log)
    reporters.end()
    assert reporters.failed == []
    check_log(pair.url, reporters.acknowledged)
