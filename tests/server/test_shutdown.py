"""How a server ends: it says so to clients that ask meanwhile, and no signal is lost."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import msgpack
import pytest
import zenoh
from processes import Processes, RunningServer
from zenoh_wire import changed_on_the_way

from crkr.protocol import TaskSpec, task_key
from crkr.server.inspection.synthetic_log import fill
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.intake import Intake
from crkr.server.queries.queue import Lane, busy
from crkr.server.queries.refusals import Refuser
from crkr.server.queries.request import Request
from crkr.server.session import open_session

Ask = Callable[..., dict[str, Any]]

PATIENCE_S = 60.0


def code(reply: zenoh.Reply) -> str:
    assert reply.err is not None
    return str(msgpack.unpackb(reply.err.payload.to_bytes())["code"])


@pytest.fixture
def router(free_port: int) -> Iterator[tuple[zenoh.Session, str]]:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        yield session, endpoint


def fails(requests: list[Request]) -> NoReturn:
    raise ZeroDivisionError("a defect")


def test_what_comes_after_the_order_to_stop_is_told_so(
    router: tuple[zenoh.Session, str], connect: Callable[[str], Ask]
) -> None:
    session, endpoint = router
    refuser = Refuser()
    intake = Intake(session, task_key("*", "*"), {}, Latencies(), refuser, fails)
    refuser.start()
    intake.start()
    intake.stop()
    for verb in ("predict", "report", "dance"):
        error = connect(endpoint)(f"task/reach/rpc/{verb}")["error"]
        assert error["code"] == "SHUTTING_DOWN"
        assert error["retry_ms"] > 0


def test_what_still_waits_when_the_patience_ends_is_told_so(
    router: tuple[zenoh.Session, str], connect: Callable[[str], Ask], processes: Processes
) -> None:
    session, endpoint = router
    working, go_on = threading.Event(), threading.Event()

    def work(requests: list[Request]) -> None:
        working.set()
        go_on.wait(10)
        for request in requests:
            request.reply({"done": True})

    lane: Lane[Request] = Lane("slow", {"samples": 10}, work)
    intake = Intake(session, task_key("*", "*"), {"samples": lane}, Latencies(), Refuser())
    lane.start()
    intake.start()
    answers: list[dict[str, Any]] = []
    asking = [
        threading.Thread(target=lambda: answers.append(connect(endpoint)("task/reach/rpc/samples"))) for _ in range(3)
    ]
    for thread in asking:
        thread.start()
    assert working.wait(10)
    processes.wait_until(lambda: lane.depths()["samples"]["waiting"] == 2)
    lane.close(0.05)
    go_on.set()
    for thread in asking:
        thread.join(10)
    assert sorted("done" if "done" in answer else answer["error"]["code"] for answer in answers) == [
        "SHUTTING_DOWN",
        "SHUTTING_DOWN",
        "done",
    ]


def test_all_for_whom_there_was_no_room_are_told_so_before_the_end(
    router: tuple[zenoh.Session, str], plain: Callable[[str], zenoh.Session]
) -> None:
    session, endpoint = router
    key = task_key("reach", "explain")
    queries = session.declare_queryable(key, zenoh.handlers.FifoChannel(1000), complete=True)
    asking = plain(endpoint)
    waiting = [asking.get(key, zenoh.handlers.FifoChannel(1), timeout=10.0) for _ in range(500)]
    refuser = Refuser()
    for _ in waiting:
        refuser.add(Request(queries.recv(), Latencies()).fail, busy("explain"))
    refuser.start()
    refuser.close(10.0)
    assert {code(replies.recv()) for replies in waiting} == {"BUSY"}


def test_refusals_after_the_last_was_sent_are_sent_too(
    router: tuple[zenoh.Session, str], plain: Callable[[str], zenoh.Session]
) -> None:
    session, endpoint = router
    key = task_key("reach", "explain")
    queries = session.declare_queryable(key, zenoh.handlers.FifoChannel(1), complete=True)
    refuser = Refuser()
    refuser.start()
    refuser.close(10.0)
    replies = plain(endpoint).get(key, zenoh.handlers.FifoChannel(1), timeout=10.0)
    refuser.add(Request(queries.recv(), Latencies()).fail, busy("explain"))
    assert code(replies.recv()) == "BUSY"


@pytest.mark.parametrize("verb", ["predict", "samples"])
def test_a_defect_is_answered_as_internal_and_the_server_goes_on(
    router: tuple[zenoh.Session, str], connect: Callable[[str], Ask], verb: str
) -> None:
    session, endpoint = router
    lane: Lane[Request] = Lane("broken", {"samples": 10}, fails)
    intake = Intake(session, task_key("*", "*"), {"samples": lane}, Latencies(), Refuser(), fails)
    lane.start()
    intake.start()
    ask = connect(endpoint)
    for _ in range(2):
        error = ask(f"task/reach/rpc/{verb}")["error"]
        assert error["code"] == "INTERNAL"
        assert "ZeroDivisionError" in error["message"]
    lane.close(1.0)


def test_a_signal_right_after_the_start_ends_the_server(free_port: int, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "crkr.client", "server", "--data", str(tmp_path / "data")]
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        listen = ["--listen", f"tcp/127.0.0.1:{free_port}"]
        with subprocess.Popen([*command, *listen], stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            assert "listening on" in process.stderr.readline()
            process.send_signal(number)
            assert process.wait(timeout=60) == 0


def test_a_signal_while_a_client_has_broken_the_session_ends_the_server_in_order(
    server: RunningServer, reach: dict[str, Any], connect: Callable[[str], Ask], plain: Callable[[str], zenoh.Session]
) -> None:
    assert connect(server.endpoint)("rpc/create_task", reach)["created"]
    # A worker's token becomes one on no key.
    with changed_on_the_way(server.port, lambda batch: batch.replace(b"live/worker", b"liv*/worker")) as endpoint:
        hostile = plain(endpoint)
        token = hostile.liveliness().declare_token("crkr/@v1/task/reach/live/worker/w")
        while b"panicked" not in server.log.read_bytes():
            list(hostile.get(task_key("reach", "status"), payload=b"\x80", timeout=0.1))
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(timeout=PATIENCE_S) == 0
        assert token is not None


def test_a_server_under_nohup_goes_on_when_the_terminal_is_closed(
    free_port: int, tmp_path: Path, connect: Callable[[str], Ask]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    command = ["nohup", sys.executable, "-m", "crkr.client", "server", "--data", str(tmp_path / "data")]
    with subprocess.Popen([*command, "--listen", endpoint], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        while "listening on" not in process.stderr.readline():
            pass  # nohup says what it ignores
        process.send_signal(signal.SIGHUP)
        assert connect(endpoint)("rpc/info")["protocol"] == 1
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=10) == 0


def test_a_signal_while_a_long_log_is_read_ends_the_server_then(
    free_port: int, tmp_path: Path, reach: dict[str, Any], processes: Processes
) -> None:
    data = tmp_path / "data"
    fill(data, TaskSpec.from_dict(reach), 40_000)
    (data / "lock").unlink()
    command = [sys.executable, "-m", "crkr.client", "server", "--data", str(data)]
    command += ["--listen", f"tcp/127.0.0.1:{free_port}"]
    for number in (signal.SIGTERM, signal.SIGINT):
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            processes.wait_until((data / "lock").exists)
            process.send_signal(number)
            assert process.communicate(timeout=60)[1] == ""
            assert process.returncode == 0
        (data / "lock").unlink()


def test_a_signal_before_the_wait_is_not_lost_nor_one_in_it() -> None:
    script = """
import os, signal, threading
from crkr.server.command import _stop_signal
for number in (signal.SIGTERM, signal.SIGINT):
    told = _stop_signal()
    os.kill(os.getpid(), number)
    assert told.recv(1)
    threading.Timer(0.1, os.kill, (os.getpid(), number)).start()
    assert told.recv(1)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=20)
