"""A data directory read without its server, and beside one."""

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from processes import RunningServer, shared_server

from crkr.client import Client, Task
from crkr.protocol import CrkrError, StorageError, StoredTrial, TaskSpec, UnknownTask
from crkr.server.inspection.stored_run import StoredRun

SPEC = TaskSpec.from_dict(
    {
        "name": "throw",
        "description": "Throw far.",
        "state": [{"name": "wind", "unit": "m/s", "low": -1.0, "high": 1.0}],
        "goal": [{"name": "angle", "unit": "rad", "low": 0.0, "high": 1.5}],
        "budget": 12,
    }
)


def thrown(client: Client) -> Task:
    """A task of two demonstrations and thirty trials, a third of them hits."""
    task = client.create_task(SPEC)
    state, goal = [[0.1 * n - 0.9] for n in range(30)], [[0.05 * n] for n in range(30)]
    task.report(state=state[:2], goal=goal[:2], cost=0.5, success=True, kind="demonstration")
    for n in range(30):
        task.report(state=state[n], goal=goal[n], cost=n / 30, success=n % 3 == 0, info={"reason": f"r{n % 3}"})
    return task


@pytest.fixture
def throw(server: RunningServer) -> Iterator[Task]:
    """Such a task of a server that goes on."""
    with Client(server.endpoint) as client:
        yield thrown(client)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data directory of a server that had such a task."""
    data = tmp_path_factory.mktemp("whole") / "data"
    with shared_server(data) as endpoint, Client(endpoint) as client:
        client.wait_until_ready(60.0)
        thrown(client)
    return data


def read(directory: Path, size: int = 7) -> tuple[TaskSpec, list[StoredTrial], dict[str, Any]]:
    """Everything, and what the last page says of the learner."""
    with closing(StoredRun(directory, "throw")) as run:
        pages = list(run.pages(size))
        assert all(len(trials) <= size for trials, _ in pages)
        return run.spec, [trial for trials, _ in pages for trial in trials], pages[-1][1]


def as_data(trials: list[StoredTrial]) -> list[dict[str, Any]]:
    return [
        {name: value.tobytes() if hasattr(value, "tobytes") else value for name, value in trial.to_wire().items()}
        for trial in trials
    ]


def test_the_trials_are_those_that_the_server_hands_out(server: RunningServer, throw: Task) -> None:
    throw.recost([next(throw.iter_samples()).trial.id], [0.25], "measured again")
    spec, trials, status = read(server.data)
    assert as_data(trials) == as_data(list(throw.iter_samples()))
    assert spec.description == "Throw far."
    assert status["seq"] == trials[-1].seq == 33


@pytest.mark.parametrize("changes", [{}, {"budget": 5}, {"learn_from": "all"}, {"budget": 9, "learn_from": "all"}])
def test_eligible_and_active_samples_are_those_that_the_server_counts(
    server: RunningServer, throw: Task, changes: dict[str, Any]
) -> None:
    throw.remove([trial.trial.id for trial in throw.iter_samples()][3:9], "wind gauge was stuck")
    if changes:
        throw.configure(changes)
    told = throw.status()
    spec, _, status = read(server.data)
    assert (status["eligible"], status["active"]) == (told["eligible"], told["active"])
    assert spec.budget == changes.get("budget", 12)


def test_a_server_goes_on_and_what_it_adds_later_is_left_out(server: RunningServer, throw: Task) -> None:
    lock = (server.data / "lock").read_bytes()
    with closing(StoredRun(server.data, "throw")) as run:
        pages = run.pages(10)
        first, _ = next(pages)
        throw.report(state=[0.5], goal=[0.5], cost=0.5, success=True)
        rest = [trial for trials, _ in pages for trial in trials]
    assert [trial.seq for trial in (*first, *rest)] == list(range(2, 34))
    assert (server.data / "lock").read_bytes() == lock
    assert throw.status()["seq"] == 34


def test_a_copy_needs_no_server_and_is_not_written(server: RunningServer, throw: Task, tmp_path: Path) -> None:
    expected = as_data(list(throw.iter_samples()))
    with closing(sqlite3.connect(server.data / "crkr.sqlite3")) as log:
        log.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    copy = tmp_path / "copy"
    copy.mkdir()
    shutil.copy(server.data / "crkr.sqlite3", copy)
    before = (copy / "crkr.sqlite3").read_bytes()
    _, trials, _ = read(copy)
    assert as_data(trials) == expected
    assert (copy / "crkr.sqlite3").read_bytes() == before
    assert not (copy / "lock").exists()


def changed(whole: Path, tmp_path: Path, statement: str) -> Path:
    """A copy of the data directory whose log was tampered with."""
    copy = tmp_path / "tampered"
    shutil.copytree(whole, copy)
    with closing(sqlite3.connect(copy / "crkr.sqlite3")) as log:
        log.execute(statement)
        log.commit()
    return copy


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("UPDATE trial SET success = 1 - success WHERE seq = 20", "the trial at log position 20 does not match"),
        ("UPDATE trial SET worker = 'x' WHERE seq = 20", "the trial at log position 20 does not match"),
        ("DELETE FROM trial WHERE seq = 20", "lacks position 20;"),
        ("DELETE FROM event WHERE kind = 'create'", "lacks position 1;"),
        ("UPDATE event SET body = x'80' WHERE kind = 'create'", "does not match its digest"),
        ("DROP TABLE trial", "restore a backup"),
    ],
)
def test_a_damaged_log_is_named(whole: Path, tmp_path: Path, statement: str, says: str) -> None:
    with pytest.raises(StorageError, match=says):
        read(changed(whole, tmp_path, statement))


def test_a_log_that_lost_its_end_is_named(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="33 were acknowledged: its end is lost"):
        read(changed(whole, tmp_path, "DELETE FROM trial WHERE seq > 30"))


def test_a_file_that_is_no_log_is_named(tmp_path: Path) -> None:
    (tmp_path / "crkr.sqlite3").write_bytes(b"no database at all, but longer than a header of one " * 40)
    with pytest.raises(StorageError, match="not a database"):
        StoredRun(tmp_path, "throw")


@pytest.mark.parametrize("make", [lambda path: path / "missing", lambda path: path])
def test_where_there_is_no_log_the_place_is_named(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    with pytest.raises(CrkrError, match=r"there is no (data directory|task log) .*"):
        StoredRun(make(tmp_path), "throw")


def test_a_task_that_is_not_there_is_answered_with_those_that_are(server: RunningServer, throw: Task) -> None:
    with Client(server.endpoint) as client:
        client.create_task(TaskSpec.from_dict({**SPEC.to_dict(), "name": "catch"}))
    with pytest.raises(UnknownTask, match=r"holds no task 'thorw'; it has throw, catch$"):
        StoredRun(server.data, "thorw")
