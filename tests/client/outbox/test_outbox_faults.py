"""What an outbox does where servers, robots, links, disks and the outbox's own file fail."""

import json
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from types import FrameType
from typing import Any, TypeAlias
from uuid import UUID, uuid4

import msgpack
import numpy as np
import pytest
from named_threads import raise_in
from processes import Processes
from small_tasks import put, stored, task_spec

from crkr.client import Client, Task
from crkr.client.outbox.outbox_file import OutboxFile
from crkr.protocol import Conflict, Invalid, Unavailable, UnknownTask, unpack

PATIENCE_S = 30.0
Start = Callable[..., Any]
Trace: TypeAlias = Callable[[FrameType, str, Any], Any]


@pytest.fixture
def task(shared_endpoint: str) -> Iterator[Task]:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        yield client.create_task(task_spec(f"lob-{uuid4()}"))


def test_a_server_killed_again_and_again_while_it_delivers_stores_each_trial_once(
    start_server: Start, free_port: int, tmp_path: Path, processes: Processes
) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        task = client.create_task(task_spec("lob"))
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
        task = client.create_task(task_spec("lob"))
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
    assert len(found) <= len(said) + 3, "only the current one may be there without a line"


def test_a_damaged_trial_is_put_aside_and_the_others_arrive(
    start_server: Start, free_port: int, tmp_path: Path
) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        client.create_task(task_spec("lob")).outbox(tmp_path / "box").close()
    server.process.terminate()
    server.process.wait()
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        ids = put(outbox, 3)
    with sqlite3.connect(tmp_path / "box") as database:
        [(body,)] = database.execute("SELECT body FROM trial WHERE number = 2").fetchall()
        changed = body.replace(np.float64(0.5).tobytes()[::-1], np.float64(0.25).tobytes()[::-1])
        assert changed != body
        database.execute("UPDATE trial SET body = ? WHERE number = 2", (changed,))
    database.close()

    start_server(port=free_port)
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        outbox.flush(PATIENCE_S)
        assert stored(client.task("lob")) == [ids[0], ids[2]]
        [damaged] = outbox.refused()
        assert (damaged.number, damaged.id, damaged.trial) == (2, None, {})
        assert damaged.error.startswith("STORAGE: trial 2 is damaged")


def test_a_trial_of_a_version_before_that_no_server_can_read_is_put_aside_and_the_others_arrive(
    task: Task, shared_endpoint: str, tmp_path: Path
) -> None:
    """It packed maps whose keys are not text, which it could not read again: everything behind them waited forever."""
    task.outbox(tmp_path / "box").close()
    unreadable = {"id": uuid4().bytes, "state": [0.0, 0.0], "goal": [0.0, 0.0], "cost": 0.1, "success": True}
    body = msgpack.packb({**unreadable, "kind": "trial", "info": {"torque": {0: 1.2}}})
    with sqlite3.connect(tmp_path / "box") as database:
        digest = blake2b(body, digest_size=16).digest()
        database.execute("INSERT INTO trial (body, digest) VALUES (?, ?)", (body, digest))
    database.close()
    with task.outbox(tmp_path / "box") as outbox:
        ids = put(outbox, 3)
        outbox.flush(PATIENCE_S)
        assert stored(task) == ids
        assert "in use already" in looked_at(shared_endpoint, tmp_path / "box")
    assert "1 were put aside, the first for STORAGE: trial 1" in looked_at(shared_endpoint, tmp_path / "box")
    with task.outbox(tmp_path / "box") as outbox:
        [refused] = outbox.refused()
        assert refused.trial["info"] == {"torque": {0: 1.2}}
        outbox.discard([refused])
        assert (outbox.pending, outbox.refused()) == (0, [])


def looked_at(endpoint: str, path: Path) -> str:
    """What `crkr doctor` says of an outbox."""
    command = [sys.executable, "-m", "crkr.client", "doctor", "--connect", endpoint, "--outbox", str(path), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, timeout=60, check=False)
    [detail] = [check["detail"] for check in json.loads(done.stdout)["checks"] if check["check"] == "outbox"]
    return str(detail)


def test_whatever_is_raised_in_its_thread_is_told_and_it_goes_on(
    task: Task, tmp_path: Path, processes: Processes
) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        for count, raised in enumerate((MemoryError, SystemExit, type("Panic", (BaseException,), {})), start=1):
            raise_in(f"crkr-outbox-{task.name}", raised)
            put(outbox, 1, count)
            processes.wait_until(lambda count=count: outbox.defects == count)
            outbox.flush(PATIENCE_S)
        assert "defects=3" in repr(outbox)


def test_another_task_of_the_same_name_is_given_nothing(
    start_server: Start, free_port: int, tmp_path: Path, processes: Processes
) -> None:
    """Where a server comes back with other data: what fits by its numbers is still not meant for it."""
    server = start_server(port=free_port, data=tmp_path / "ours")
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        task = client.create_task(task_spec("lob"))
        with task.outbox(tmp_path / "box") as outbox:
            ids = put(outbox, 5)
            outbox.flush(PATIENCE_S)
            server.process.kill()
            server.process.wait()
            server = start_server(port=free_port, data=tmp_path / "theirs")
            ids += put(outbox, 5)
            processes.wait_until(lambda: isinstance(outbox.fault, UnknownTask))

            fields = task_spec("lob").to_dict()
            fields["goal"][1]["high"] = 2.0
            other = client.create_task(fields)
            processes.wait_until(lambda: isinstance(outbox.fault, Conflict))
            assert outbox.fault is not None
            assert list(outbox.fault.details["fields"]) == ["goal"]
            assert (outbox.pending, outbox.refused(), stored(other)) == (5, [], [])

            server.process.kill()
            server.process.wait()
            start_server(port=free_port, data=tmp_path / "ours")
            outbox.flush(PATIENCE_S)
            assert stored(client.task("lob")) == ids


def test_an_archived_task_puts_no_trial_aside(task: Task, tmp_path: Path, processes: Processes) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        put(outbox, 3)
        outbox.flush(PATIENCE_S)
        task.archive()
        put(outbox, 300)
        processes.wait_until(lambda: isinstance(outbox.fault, Invalid))
        with pytest.raises(Unavailable, match="archived"):
            outbox.flush(0.1)
        assert (outbox.pending, outbox.refused()) == (300, [])


def test_a_link_that_carries_no_large_message_in_time_is_given_small_ones(
    make_peer: Callable[..., Any], tmp_path: Path
) -> None:
    delivered: list[int] = []

    def answer(number: int) -> object:
        key, payload, _ = peer.queries[number]
        if key.endswith("info"):
            return {"server_id": bytes(16)}
        if key.endswith("spec"):
            return {"spec": task_spec("lob").to_dict()}
        if len(payload) > 3000:
            return "silence"
        count = len(unpack(payload)["trials"])
        delivered.append(count)
        return {"accepted": count, "duplicates": 0, "seqs": list(range(count)), "model_version": 1}

    peer = make_peer(answer)
    with Client(peer.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        info = {"note": "x" * 1000}
        outbox.report(state=np.zeros((5, 2)), goal=np.zeros((5, 2)), cost=0.1, success=True, info=info)
        outbox.flush(PATIENCE_S)
    assert delivered == [2, 2, 1]


def test_an_interrupted_report_leaves_the_count_exact(start_server: Start, free_port: int, tmp_path: Path) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint) as client:
        client.create_task(task_spec("lob")).outbox(tmp_path / "box").close()
    server.process.terminate()
    server.process.wait()
    interrupted = 0
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        put(outbox, 1)  # NumPy imports at the first one, and swallows what is raised there
        previous = signal.signal(signal.SIGALRM, signal.default_int_handler)
        try:
            for part in range(60):
                try:
                    signal.setitimer(signal.ITIMER_REAL, 0.0005 + 0.0001 * part)
                    put(outbox, 100)
                except KeyboardInterrupt:
                    interrupted += 1
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0.0)
        finally:
            signal.signal(signal.SIGALRM, previous)
        assert interrupted == 60
        counted = outbox.pending
    file = OutboxFile.existing(tmp_path / "box")
    assert file.pending() == counted
    file.close()


@contextmanager
def interrupted_at(place: int) -> Iterator[None]:
    """Raises KeyboardInterrupt at one of the calls and returns inside the outbox, by their order."""
    left = place

    def trace(frame: FrameType, event: str, _: object) -> Trace | None:
        nonlocal left
        if Path(frame.f_code.co_filename).name not in {"outbox.py", "outbox_file.py", "contextlib.py"}:
            return None
        if event in {"call", "return"}:
            left -= 1
            if left < 0:
                raise KeyboardInterrupt
        return trace

    previous = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(previous)


def test_an_interrupt_anywhere_in_a_report_leaves_the_outbox_usable(
    start_server: Start, free_port: int, tmp_path: Path
) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint) as client:
        client.create_task(task_spec("lob")).outbox(tmp_path / "box").close()
    server.process.terminate()
    server.process.wait()
    interrupts = []
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        put(outbox, 1)
        for place in range(1000):
            try:
                with interrupted_at(place):
                    outbox.report(state=[0.5, 0.5], goal=[0.0, 0.0], cost=0.5, success=True)
                break
            except KeyboardInterrupt as interrupt:
                interrupts.append(interrupt)  # with the frames that it left, and what those hold
            finally:
                before = outbox.pending
                put(outbox, 1)
                assert outbox.pending == before + 1
        counted = outbox.pending
    assert len(interrupts) > 20
    file = OutboxFile.existing(tmp_path / "box")
    assert file.pending() == counted
    file.close()


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
        client.create_task(task_spec("lob")).outbox(tmp_path / "box").close()
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
