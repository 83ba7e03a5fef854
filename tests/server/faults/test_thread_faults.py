"""No thread of the server ends silently: what it raises is counted and told, and it goes on."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
import zenoh
from processes import Processes, RunningServer
from zenoh_wire import changed_on_the_way

from crkr.client import Client
from crkr.client.network.config import Connection
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.rpc import Rpc
from crkr.protocol import Unsupported, pack, task_key
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.intake import Intake
from crkr.server.queries.queue import Lane, busy
from crkr.server.queries.refusals import Refuser
from crkr.server.queries.request import Request
from crkr.server.queries.standby_thread import StandbyThread
from crkr.server.session import open_session
from crkr.server.stderr_log import StderrLog
from crkr.server.thread_faults import FAULTS, ThreadFaults, keep_running, run_once

ROOT = "crkr/@v1"
PATIENCE_S = 60.0


class Panic(BaseException):
    """As a binding raises it: no `except Exception` catches it."""


RAISED = [Panic("!"), MemoryError(), RecursionError(), SystemExit(1), KeyboardInterrupt(), ValueError("!")]


def faults(thread: str) -> int:
    return FAULTS.counts().get(thread, 0)


def test_a_thread_goes_on_whatever_is_raised_and_each_fault_is_counted() -> None:
    steps = [*RAISED, None, *RAISED, None]

    def step() -> bool:
        if (error := steps.pop(0)) is not None:
            raise error
        return bool(steps)

    before = faults("steps")
    thread = threading.Thread(target=keep_running, args=(step,), name="steps", daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert faults("steps") == before + 2 * len(RAISED)


def test_a_thread_goes_on_after_an_error_in_the_pause_between_its_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    class ShortOfMemory(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            if timeout is not None and threading.current_thread().name == "short":
                raise MemoryError
            return super().wait(timeout)

    steps: list[BaseException | None] = [ValueError(), ValueError(), ValueError(), None]

    def step() -> bool:
        if (error := steps.pop(0)) is not None:
            raise error
        return False

    monkeypatch.setattr(threading, "Event", ShortOfMemory)
    before = faults("short")
    thread = threading.Thread(target=keep_running, args=(step,), name="short", daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert not steps
    assert faults("short") == before + 3 + 2  # the first failure is followed by no pause


def test_what_has_one_thing_to_do_is_counted_too() -> None:
    def work() -> None:
        raise Panic

    before = faults("single")
    thread = threading.Thread(target=run_once, args=(work,), name="single", daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert faults("single") == before + 1


def test_a_thread_that_ended_all_the_same_is_told_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(threading, "excepthook", seen.append)
    found = ThreadFaults()
    found.watch()

    def work() -> None:
        raise Panic

    thread = threading.Thread(target=work, name="doomed")
    thread.start()
    thread.join(PATIENCE_S)
    assert found.summary() == {"faults": {}, "ended": ["doomed"]}
    assert len(seen) == 1


def test_made_up_thread_names_do_not_fill_the_counts() -> None:
    found = ThreadFaults()
    for number in range(1000):
        found.note(ValueError(), f"Thread-{number} (serve)")
        found.note(ValueError(), f"name {number}")
    counts = found.counts()
    assert counts["serve"] == 1000
    assert len(counts) <= 65
    assert sum(counts.values()) == 2000


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_a_lane_answers_what_raised_and_what_comes_behind_it(
    error: BaseException, free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    key, endpoint = task_key("reach", "explain"), f"tcp/127.0.0.1:{free_port}"

    def work(requests: list[Request]) -> None:
        if requests[0].message().get("bad"):
            raise error
        requests[0].reply({"done": True})

    with open_session(endpoint, None) as session:
        queries = session.declare_queryable(key, zenoh.handlers.FifoChannel(10), complete=True)
        asking, lane = plain(endpoint), Lane[Request]("faulty lane", {"explain": 10}, work)
        lane.start()
        codes = []
        for bad in (True, False):
            replies = asking.get(key, zenoh.handlers.FifoChannel(1), payload=pack({"bad": bad}), timeout=PATIENCE_S)
            assert lane.offer(Request(queries.recv(), Latencies())) is None
            reply = replies.recv()
            codes.append(None if reply.err is None else msgpack.unpackb(reply.err.payload.to_bytes())["code"])
        lane.close(5.0)
    assert codes == ["INTERNAL", None]


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_the_intake_answers_what_raised_and_what_comes_behind_it(
    error: BaseException, free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    endpoint, asked = f"tcp/127.0.0.1:{free_port}", []

    def predict(requests: list[Request]) -> list[Request]:
        asked.append(len(requests))
        if len(asked) == 1:
            raise error
        for request in requests:
            request.reply({})
        return []

    with open_session(endpoint, None) as session:
        refuser = Refuser()
        intake = Intake(session, task_key("*", "*"), {}, Latencies(), refuser, predict)
        intake.start()
        asking, found = plain(endpoint), []
        for _ in range(3):
            replies = asking.get(task_key("reach", "predict"), zenoh.handlers.FifoChannel(1), timeout=PATIENCE_S)
            found.append(replies.recv().ok is not None)
    assert found == [False, True, True]


def test_refusals_go_on_after_one_that_cannot_be_told(processes: Processes) -> None:
    refuser = Refuser()
    told: list[Any] = []

    def fails(_: Any) -> None:
        raise Panic

    refuser.start()
    for tell in (fails, told.append):
        assert refuser.add(tell, busy("explain"))
    processes.wait_until(lambda: len(told) == 1)
    refuser.close(1.0)


def test_the_log_goes_on_when_standard_error_is_closed(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    log = StderrLog(50)
    with open("/dev/null", "w") as closed:
        pass
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", closed)
        log.add("lost")
        log.flush(PATIENCE_S)
    log.add("told")
    log.flush(PATIENCE_S)
    assert "told" in capsys.readouterr().err


def test_where_no_thread_can_take_over_the_old_one_stays_on_duty(monkeypatch: pytest.MonkeyPatch) -> None:
    relay = StandbyThread(lambda _turn: None, "relay")
    monkeypatch.setattr(threading.Thread, "start", lambda _self: (_ for _ in ()).throw(RuntimeError("no thread")))
    with pytest.raises(RuntimeError):
        relay.start()
    assert relay.end(0)


def number(value: int) -> bytes:
    """As Zenoh writes whole numbers: seven bits a byte, the lowest first."""
    written = b""
    while value > 127:
        written, value = written + bytes([value & 127 | 128]), value >> 7
    return written + bytes([value])


def message_start(batch: bytes) -> int:
    """Where the first message of a frame starts: behind one byte and a number, whose first value is random."""
    place = 1
    while batch[place] & 128:
        place += 1
    return place + 1


def overlong(first: bytes, rest: bytes, seen: list[int]) -> Callable[[bytes], bytes]:
    """Makes of a publication a declared prefix, and of the next message one on that prefix and a suffix.

    The next may be sent when `seen` has one entry, or both would come in one batch.
    """
    dummy = f"{ROOT}/x/dummy".encode()

    def change(batch: bytes) -> bytes:
        place = batch.find(dummy)
        if place < 0:
            return batch
        start = message_start(batch)
        seen.append(place)
        if len(seen) == 1:
            return batch[:start] + b"\x9e\x21\x08\x20\x09\0" + number(len(first)) + first
        head = b"\x7d" if batch[start] == 0x7D else b"\xfc" + batch[start + 1 : place - 2]
        return batch[:start] + head + b"\x09" + number(len(rest)) + rest + batch[place + len(dummy) + 1 :]

    return change


@pytest.mark.parametrize("verb", ["rpc/report", "admin/remove", "rpc/status", "dance"])
def test_a_key_longer_than_zenoh_can_answer_harms_nobody_else(
    verb: str, server: RunningServer, reach: dict[str, Any], plain: Callable[[str], zenoh.Session], processes: Processes
) -> None:
    seen: list[int] = []
    prefix = f"{ROOT}/task/{'k' * 40_000}" if "/" in verb else f"{ROOT}/task/reach/rpc/{'k' * 40_000}"
    change = overlong(prefix.encode(), f"{'s' * 26_000}{'/' + verb if '/' in verb else ''}".encode(), seen)
    with Client(server.endpoint) as client, changed_on_the_way(server.port, change) as endpoint:
        task = client.create_task(reach)
        task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, wait=True)
        hostile = plain(endpoint)
        hostile.put(f"{ROOT}/x/dummy1", b"x")
        processes.wait_until(lambda: seen, server.log)
        list(hostile.get(f"{ROOT}/x/dummy2", payload=b"", timeout=2.0))
        assert task.predict([0.5, 0.5], timeout_s=PATIENCE_S).active == 1
        receipt = task.report(state=[0.4, 0.5], goal=[0.0] * 3, cost=0.5, success=True, timeout_s=PATIENCE_S)
        assert receipt.seqs == (3,)  # stored once, though the first attempt may have been lost
        assert task.status(timeout_s=PATIENCE_S)["samples"]["trial"] == 2
        assert len(task.samples(timeout_s=PATIENCE_S)[0]) == 2
        with ZenohTransport(Connection.choose(endpoint, None)) as transport, pytest.raises(Unsupported, match="dance"):
            Rpc(transport, PATIENCE_S).call(task_key("reach", "dance"), {}, PATIENCE_S)


@pytest.mark.parametrize(
    ("threads", "code"),
    [(None, 0), ({"faults": {"write": 3}, "ended": []}, 0), ({"faults": {}, "ended": ["write"]}, 1)],
)
def test_the_health_probe_fails_where_a_thread_ended(threads: Any, code: int, free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    answer = {"protocol": 1, "version": "0", "server_id": bytes(16), "started": 0.0, "tasks": [], "limits": {}}
    answer |= {} if threads is None else {"threads": threads}
    with open_session(endpoint, None) as session:
        info = session.declare_queryable(
            f"{ROOT}/rpc/info", lambda query: query.reply(query.key_expr, pack(answer), encoding="application/msgpack")
        )
        command = [sys.executable, "-m", "crkr.client", "status", "--connect", endpoint]
        check = subprocess.run([*command, "--check"], capture_output=True, text=True, timeout=60, check=False)
        shown = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
        assert info is not None
    assert check.returncode == code
    assert ("write" in shown) == (threads is not None)


def test_subscribers_whose_connections_an_overlong_publication_broke_are_answered_again(
    server: RunningServer, reach: dict[str, Any], plain: Callable[[str], zenoh.Session], processes: Processes
) -> None:
    seen: list[int] = []
    change = overlong(f"{ROOT}/task/reach/pub/{'k' * 40_000}".encode(), b"s" * 26_000, seen)
    transport = ZenohTransport(Connection.choose(server.endpoint, None))
    with (
        Client(server.endpoint, timeout_s=PATIENCE_S) as client,
        Client(transport=transport, timeout_s=PATIENCE_S) as listening,
        changed_on_the_way(server.port, change) as endpoint,
    ):
        task = client.create_task(reach)
        task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, wait=True)
        session = transport.connect(PATIENCE_S + time.monotonic())
        subscriber = session.declare_subscriber(f"{ROOT}/task/reach/pub/*", zenoh.handlers.FifoChannel(100))
        assert listening.task("reach").predict([0.5, 0.5]).active == 1
        with task.announce("ada"):
            hostile = plain(endpoint)
            hostile.put(f"{ROOT}/x/dummy1", b"x")
            processes.wait_until(lambda: seen, server.log)
            hostile.put(f"{ROOT}/x/dummy2", b"x")
            processes.wait_until(lambda: b"panicked" in server.log.read_bytes(), server.log)
            for one in (listening, client):
                assert one.task("reach").predict([0.5, 0.5]).active == 1
            assert task.report(state=[0.4, 0.5], goal=[0.0] * 3, cost=0.5, success=True, wait=True).accepted == 1
            told = processes.wait_until(lambda: task.status().get("threads"), server.log)
            assert sum(told["faults"].values()) >= 1
            assert told["ended"] == []
            processes.wait_until(lambda: task.status()["workers"][0]["state"] == "alive", server.log)
        assert subscriber is not None


def test_a_session_that_a_token_on_no_key_broke_is_opened_anew(
    server: RunningServer, reach: dict[str, Any], plain: Callable[[str], zenoh.Session], processes: Processes
) -> None:
    def spoilt(batch: bytes) -> bytes:
        return batch.replace(b"live/worker", b"liv*/worker")

    with (
        Client(server.endpoint, timeout_s=PATIENCE_S) as client,
        changed_on_the_way(server.port, spoilt) as endpoint,
    ):
        task = client.create_task(reach)
        task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, wait=True)
        hostile = plain(endpoint)
        token = hostile.liveliness().declare_token(f"{ROOT}/task/reach/live/worker/w")
        processes.wait_until(lambda: not hostile_answer(hostile), server.log)
        hostile.close()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the type
        processes.wait_until(lambda: b"opened again" in server.log.read_bytes(), server.log)
        assert task.predict([0.5, 0.5]).active == 1
        assert task.report(state=[0.4, 0.5], goal=[0.0] * 3, cost=0.5, success=True, wait=True).accepted == 1
        with Client(server.endpoint, timeout_s=PATIENCE_S) as another:
            assert another.task("reach").status()["samples"]["trial"] == 2
        assert server.process.poll() is None
        assert token is not None


def hostile_answer(session: zenoh.Session) -> bool:
    """Whether a query below the spoilt key is answered."""
    replies = session.get(f"{ROOT}/task/reach/rpc/status", zenoh.handlers.FifoChannel(1), payload=b"\x80", timeout=1.0)
    return any(reply.ok is not None for reply in replies)
