"""The log's end comes in order, whatever other threads do with it just then."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self
from uuid import UUID

import pytest

from crkr.protocol import StorageError, TaskSpec, Trial
from crkr.server.log import PendingReport, SqliteLog

AXIS = {"name": "x", "unit": "m", "low": -1.0, "high": 1.0}
SPEC = TaskSpec.from_dict({"name": "reach", "state": [AXIS], "goal": [AXIS]})


def trial(number: int) -> Trial:
    return Trial.create(SPEC, id=UUID(int=number), state=[0.5], goal=[0.5], cost=0.5, success=True, kind="trial")


@pytest.fixture
def log(tmp_path: Path) -> Iterator[SqliteLog]:
    log = SqliteLog(tmp_path / "data")
    log.create(SPEC)
    yield log
    log.close()


class SlowTrials(tuple[Trial, ...]):
    """Trials whose commit takes as long as on a disk that does not answer."""

    def __new__(cls, *trials: Trial) -> Self:
        made = super().__new__(cls, trials)
        made.began, made.go_on = threading.Event(), threading.Event()
        return made

    began: threading.Event
    go_on: threading.Event

    def __iter__(self) -> Iterator[Trial]:
        self.began.set()
        self.go_on.wait(30)
        return super().__iter__()


def test_a_commit_that_outlasts_the_end_of_the_log_is_whole(log: SqliteLog) -> None:
    stored: list[Any] = []
    trials = SlowTrials(trial(1))
    writing = threading.Thread(target=lambda: stored.append(log.append_reports([PendingReport("reach", trials)])))
    writing.start()
    assert trials.began.wait(30)
    with pytest.raises(StorageError, match="it ends by itself"):
        log.close()
    trials.go_on.set()
    writing.join(30)
    assert [one.seqs for one in stored[0]] == [(2,)]
    with pytest.raises(StorageError, match="closed"):
        log.append_reports([PendingReport("reach", (trial(2),))])
    again = SqliteLog(log.path.parent)  # so it let go of the directory
    assert [entry.seq for entry in again.reads.read("reach", 1)] == [2]
    again.close()


def test_a_reading_thread_may_go_on_after_the_end_of_the_log(log: SqliteLog) -> None:
    log.append_reports([PendingReport("reach", tuple(trial(n) for n in range(1, 301)))])
    began, go_on = threading.Event(), threading.Event()
    found: list[int] = []

    def read() -> None:
        for entry in log.reads.read("reach", 1):
            found.append(entry.seq)
            began.set()
            go_on.wait(10)

    reading = threading.Thread(target=read)
    reading.start()
    assert began.wait(10)
    log.close()
    go_on.set()
    reading.join(10)
    assert found == list(range(2, 302))
