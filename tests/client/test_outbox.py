"""What an outbox took is stored by the server once: after lost links, restarts of either side, and refused trials."""

import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest

from crkr.client import Client, Outbox, Task
from crkr.protocol import Conflict, Invalid, StorageError, TaskSpec, Unavailable

PATIENCE_S = 30.0
Start = Callable[..., Any]


def specification(name: str) -> TaskSpec:
    return TaskSpec.from_dict(
        {
            "name": name,
            "state": [{"name": name, "low": 0, "high": 1} for name in "xy"],
            "goal": [{"name": name, "low": -1, "high": 1} for name in "gh"],
        }
    )


def put(outbox: Outbox, count: int, seed: int = 0) -> list[UUID]:
    """Reports `count` trials one by one; their ids."""
    rng = np.random.default_rng(seed)
    return [
        outbox.report(
            state=rng.uniform(0, 1, 2), goal=rng.uniform(-1, 1, 2), cost=0.5, success=bool(rng.integers(2)), worker="w"
        )[0]
        for _ in range(count)
    ]


def stored(task: Task) -> list[UUID]:
    return [entry.trial.id for entry in task.iter_samples()]


@pytest.fixture
def task(shared_endpoint: str) -> Iterator[Task]:
    with Client(shared_endpoint) as client:
        yield client.create_task(specification(f"lob-{uuid4()}"))


def test_what_is_reported_arrives_in_order_and_once(task: Task, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        ids = put(outbox, 600)
        ids += outbox.report(state=np.zeros((300, 2)), goal=np.zeros((300, 2)), cost=0.1, success=True)
        outbox.flush(PATIENCE_S)
        assert (outbox.pending, outbox.refused(), outbox.fault) == (0, [], None)
        assert stored(task) == ids


def test_trials_arrive_as_they_were_reported(task: Task, tmp_path: Path) -> None:
    fields: dict[str, Any] = {
        "state": [0.1, 0.7],
        "goal": [-0.3, 1.0],
        "cost": 0.25,
        "success": True,
        "kind": "demonstration",
        "worker": "left arm",
        "model_version": 3,
        "info": {"note": "von Hand", "list": [1, 2.5, None]},
    }
    with task.outbox(tmp_path / "box") as outbox:
        [identity] = outbox.report(**fields)
        outbox.flush(PATIENCE_S)
    [entry] = task.iter_samples()
    assert task.report(**fields, id=identity).duplicates == 1
    assert (entry.trial.kind, entry.trial.worker, entry.trial.info) == ("demonstration", "left arm", fields["info"])


def test_an_answer_of_predict_is_reported_under_its_id(task: Task, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        put(outbox, 30)
        outbox.flush(PATIENCE_S)
        answer = task.predict([0.5, 0.5], explore=True)
        assert outbox.report(answer, cost=0.1, success=True) == (answer.trial_id,)
        outbox.flush(PATIENCE_S)
    assert stored(task)[-1] == answer.trial_id


def test_without_a_server_reports_are_kept_and_the_next_outbox_delivers_them(
    start_server: Start, free_port: int, tmp_path: Path
) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        client.create_task(specification("lob"))
        client.task("lob").outbox(tmp_path / "box").close()
    server.process.terminate()
    server.process.wait()

    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        ids = put(outbox, 40)
        with pytest.raises(Unavailable, match="40 trials are still in the outbox"):
            outbox.flush(0.5)
        assert outbox.pending == 40

    start_server(port=free_port)
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        outbox.flush(PATIENCE_S)
        assert stored(client.task("lob")) == ids


def test_a_new_file_needs_a_server_once(free_port: int, tmp_path: Path) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}", timeout_s=0.3) as client:
        for _ in range(2):
            with pytest.raises(Unavailable):
                client.task("lob").outbox(tmp_path / "box")


def test_a_server_killed_again_and_again_while_it_delivers_stores_each_trial_once(
    start_server: Start, free_port: int, tmp_path: Path, processes: Any
) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        task = client.create_task(specification("lob"))
        with task.outbox(tmp_path / "box") as outbox, ThreadPoolExecutor(1) as pool:
            reporting = pool.submit(put, outbox, 1500)
            for part in (200, 600, 1000):
                processes.wait_until(lambda part=part: sum(task.status()["samples"].values()) >= part)
                server.process.send_signal(signal.SIGKILL)
                server.process.wait()
                server = start_server(port=free_port)
            ids = reporting.result(PATIENCE_S)
            outbox.flush(PATIENCE_S)
            assert stored(task) == ids


ROBOT = """
import sys
import numpy as np
from pathlib import Path
from crkr.client import Client

with Client(sys.argv[1]) as client, client.task("lob").outbox(Path(sys.argv[2])) as outbox:
    while True:
        [identity] = outbox.report(state=np.full(2, 0.5), goal=np.zeros(2), cost=0.5, success=True)
        print(identity, flush=True)
"""


def test_a_robot_killed_again_and_again_loses_no_report(start_server: Start, tmp_path: Path) -> None:
    server = start_server()
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        task = client.create_task(specification("lob"))
        said: list[UUID] = []
        for _ in range(3):
            command = [sys.executable, "-c", ROBOT, server.endpoint, str(tmp_path / "box")]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as robot:
                assert robot.stdout is not None
                lines = [robot.stdout.readline() for _ in range(100)]
                robot.kill()
                lines += robot.stdout.readlines()
            said += [UUID(line.strip()) for line in lines if line.endswith("\n")]
        with task.outbox(tmp_path / "box") as outbox:
            outbox.flush(PATIENCE_S)
        found = stored(task)
    assert len(found) == len(set(found))
    assert set(said) <= set(found)
    assert len(found) <= len(said) + 3, "only the one in hand may be there without having been said"


def test_a_trial_that_is_refused_is_put_aside_and_the_others_arrive(task: Task, tmp_path: Path) -> None:
    taken = uuid4()
    task.report(state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.9, success=True, id=taken)
    with task.outbox(tmp_path / "box") as outbox:
        before = put(outbox, 100, 1)
        outbox.report(state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.1, success=True, id=taken)
        after = put(outbox, 100, 2)
        outbox.flush(PATIENCE_S)
        [refused] = outbox.refused()
        assert (refused.id, refused.error.split(":")[0], refused.trial["cost"]) == (taken, "CONFLICT", 0.1)
        assert stored(task) == [taken, *before, *after]
    with task.outbox(tmp_path / "box") as outbox:
        assert [one.id for one in outbox.refused()] == [taken]
        outbox.discard(outbox.refused())
        assert outbox.refused() == []


def test_what_is_not_valid_is_refused_at_once_and_not_kept(task: Task, tmp_path: Path) -> None:
    good: dict[str, Any] = {"state": [0.1, 0.2], "goal": [0.0, 0.0], "cost": 0.5, "success": True}
    with task.outbox(tmp_path / "box") as outbox:
        for change in ({"goal": [0.0, 2.0]}, {"cost": 1.5}, {"state": [0.1]}, {"state": [0.1, np.nan]}, {"kind": "x"}):
            with pytest.raises(Invalid):
                outbox.report(**{**good, **change})
        assert outbox.pending == 0
    with pytest.raises(Unavailable, match="closed"):
        outbox.report(**good)
    outbox.close()
    assert stored(task) == []


def test_a_file_has_one_outbox_at_a_time_and_one_task(task: Task, shared_endpoint: str, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box"):
        with pytest.raises(StorageError, match="in use already"):
            task.outbox(tmp_path / "box")
        other = subprocess.run(
            [sys.executable, "-c", ROBOT.replace('"lob"', repr(task.name)), shared_endpoint, str(tmp_path / "box")],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert "in use already" in other.stderr
    with Client(shared_endpoint) as client:
        second = client.create_task(specification(f"lob-{uuid4()}"))
        with pytest.raises(Conflict, match=task.name):
            second.outbox(tmp_path / "box")


@pytest.mark.parametrize("content", [b"not a database at all" * 100, b"", "another database"])
def test_a_file_that_is_no_outbox_is_refused_and_left_as_it_is(
    task: Task, tmp_path: Path, content: bytes | str
) -> None:
    path = tmp_path / "box"
    if isinstance(content, str):
        with sqlite3.connect(path) as database:
            database.execute("CREATE TABLE theirs (x)")
        database.close()
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    if not before:  # an empty file is a new one
        task.outbox(path).close()
        return
    with pytest.raises(StorageError, match=re.escape(str(path))):
        task.outbox(path)
    if isinstance(content, bytes):
        assert path.read_bytes() == before
    else:
        with sqlite3.connect(path) as database:
            assert database.execute("SELECT name FROM sqlite_master").fetchall() == [("theirs",)]
        database.close()


def test_a_directory_that_is_not_there_is_named(task: Task, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="nowhere"):
        task.outbox(tmp_path / "nowhere" / "box")


def test_a_damaged_trial_is_never_sent(start_server: Start, free_port: int, tmp_path: Path, processes: Any) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        client.create_task(specification("lob")).outbox(tmp_path / "box").close()
    server.process.terminate()
    server.process.wait()
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        put(outbox, 3)
    with sqlite3.connect(tmp_path / "box") as database:
        [(body,)] = database.execute("SELECT body FROM trial WHERE number = 2").fetchall()
        changed = body.replace(np.float64(0.5).tobytes()[::-1], np.float64(0.25).tobytes()[::-1])
        assert changed != body
        database.execute("UPDATE trial SET body = ? WHERE number = 2", (changed,))
    database.close()

    start_server(port=free_port)
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        processes.wait_until(lambda: outbox.fault)
        assert isinstance(outbox.fault, StorageError)
        assert "trial 2" in outbox.fault.message
        assert stored(client.task("lob")) == []


FULL = """
import resource, signal, sys
import numpy as np
from pathlib import Path
from crkr.client import Client
from crkr.protocol import StorageError

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
with Client(sys.argv[1], timeout_s=0.2) as client, client.task("lob").outbox(Path(sys.argv[2])) as outbox:
    soft = Path(sys.argv[2] + "-wal").stat().st_size + 200_000
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, resource.RLIM_INFINITY))
    try:
        while True:
            [identity] = outbox.report(state=np.full(2, 0.5), goal=np.zeros(2), cost=0.5, success=True)
            print(identity, flush=True)
    except StorageError as error:
        print(error.message, file=sys.stderr)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    [identity] = outbox.report(state=np.full(2, 0.5), goal=np.zeros(2), cost=0.5, success=True)
    print(identity, flush=True)
"""


def test_a_full_disk_is_told_and_loses_nothing(start_server: Start, free_port: int, tmp_path: Path) -> None:
    """By a limit on the size of files, as for a disk without room; nobody serves meanwhile, so that they stay."""
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        client.create_task(specification("lob")).outbox(tmp_path / "box").close()
    server.process.terminate()
    server.process.wait()
    command = [sys.executable, "-c", FULL, server.endpoint, str(tmp_path / "box")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr
    assert "cannot be written" in done.stderr
    said = [UUID(line) for line in done.stdout.split()]
    assert len(said) > 20
    start_server(port=free_port)
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        outbox.flush(PATIENCE_S)
        assert stored(client.task("lob")) == said
