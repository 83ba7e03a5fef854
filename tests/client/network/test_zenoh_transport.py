"""What the client does with every kind of answer, and with none; the other side is an independent Zenoh peer."""

import logging
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any
from uuid import UUID

import msgpack
import pytest

from crkr.client import Client
from crkr.client.network.config import Connection
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.rpc import Rpc
from crkr.protocol import (
    MAX_MESSAGE_BYTES,
    Conflict,
    CrkrError,
    Internal,
    Invalid,
    NoSamples,
    NovelState,
    StorageError,
    Unavailable,
    UnknownTask,
    Unsupported,
)

MakePeer = Callable[..., Any]
INFO = {"protocol": 1, "tasks": []}
BUSY = Exception({"code": "BUSY", "message": "queue full", "retry_ms": 5})
LEAVING = Exception({"code": "SHUTTING_DOWN", "message": "leaving"})


@contextmanager
def rpc(endpoint: str, timeout_s: float = 5.0) -> Iterator[Rpc]:
    with ZenohTransport(Connection.choose(endpoint, None)) as transport:
        yield Rpc(transport, timeout_s)


def test_an_answer_is_returned_and_the_question_says_what_it_is(make_peer: MakePeer) -> None:
    peer = make_peer([INFO])
    with Client(peer.endpoint) as client:
        assert client.info() == INFO
    assert peer.queries == [("crkr/@v1/rpc/info", b"\x80", "application/msgpack;crkr.info.v1")]


@pytest.mark.parametrize("first", [BUSY, LEAVING, "silence", "hold"], ids=["busy", "leaving", "silence", "timeout"])
def test_an_attempt_without_an_answer_is_repeated_with_the_same_bytes(make_peer: MakePeer, first: object) -> None:
    peer = make_peer([first, {"goals": []}])
    with rpc(peer.endpoint) as calls:
        calls.call("crkr/@v1/task/a/rpc/predict", {"states": [1.0]})
    assert len(peer.queries) == 2
    assert peer.queries[0] == peer.queries[1]


def test_busy_is_asked_again_no_sooner_than_it_wishes(make_peer: MakePeer) -> None:
    times: list[float] = []

    def script(number: int) -> object:
        times.append(time.monotonic())
        return INFO if number else Exception({"code": "BUSY", "message": "full", "retry_ms": 80})

    peer = make_peer(script)
    with Client(peer.endpoint) as client:
        client.info()
    assert times[1] - times[0] >= 0.08


@pytest.mark.parametrize("answer", [BUSY, LEAVING, "silence", "hold"], ids=["busy", "leaving", "silence", "timeout"])
def test_the_deadline_ends_it_with_an_error_that_names_endpoint_key_and_time(
    make_peer: MakePeer, answer: object
) -> None:
    peer = make_peer([answer])
    with Client(peer.endpoint, timeout_s=0.7) as client, pytest.raises(Unavailable) as caught:
        client.info()
    assert re.search(rf"{peer.endpoint} to crkr/@v1/rpc/info in 0\.\d s and \d+ attempts", caught.value.message)
    assert caught.value.details["attempts"] >= 2
    assert 0.7 <= caught.value.details["tried_s"] < 2.0


def test_a_server_that_is_not_there_is_named_in_one_line(free_port: int) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}", timeout_s=0.2) as client, pytest.raises(Unavailable) as caught:
        client.info()
    tried = caught.value.details["tried_s"]
    said = (
        f"no server at tcp/127.0.0.1:{free_port} within {tried:.1f} s; start one: crkr server, or ask why: crkr doctor"
    )
    assert caught.value.message == said
    assert caught.value.details["key"] == "crkr/@v1/rpc/info"
    assert caught.value.details["attempts"] >= 1


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        ("INVALID", Invalid),
        ("UNKNOWN_TASK", UnknownTask),
        ("NO_SAMPLES", NoSamples),
        ("NOVEL_STATE", NovelState),
        ("CONFLICT", Conflict),
        ("UNSUPPORTED", Unsupported),
        ("STORAGE", StorageError),
        ("INTERNAL", Internal),
        ("A_CODE_OF_TOMORROW", Internal),
    ],
)
def test_a_code_is_an_exception_at_the_first_answer(make_peer: MakePeer, code: str, kind: type[CrkrError]) -> None:
    seen = UUID(int=7)
    peer = make_peer([Exception({"code": code, "message": "so it is", "details": {"id": seen.bytes}})])
    with Client(peer.endpoint) as client, pytest.raises(kind, match="so it is") as caught:
        client.info()
    assert caught.value.details == {"id": seen}
    assert len(peer.queries) == 1


@pytest.mark.parametrize(
    "reply",
    [
        Exception(b"\xff\xff nonsense"),
        Exception(b""),
        b"\xc1",
        b"\xdf\xff\xff\xff\xff",
        b"\x91\x01",
        msgpack.packb({"tasks": 3}),
        msgpack.packb({"tasks": [{"spec": 1, "samples": 2}]}),
        msgpack.packb({"tasks": [7]}),
    ],
)
def test_an_unreadable_answer_is_the_servers_fault_not_the_callers(make_peer: MakePeer, reply: object) -> None:
    peer = make_peer([reply])
    with Client(peer.endpoint) as client, pytest.raises(Internal):
        client.tasks()


def test_an_answer_of_another_protocol_version_is_refused(make_peer: MakePeer) -> None:
    peer = make_peer([(msgpack.packb(INFO), "application/msgpack;crkr.info.v2")])
    with Client(peer.endpoint) as client, pytest.raises(Unsupported, match=r"v2"):
        client.info()


def test_a_message_over_the_limit_never_leaves(make_peer: MakePeer) -> None:
    peer = make_peer([INFO])
    with rpc(peer.endpoint) as calls, pytest.raises(Invalid, match="the limit is"):
        calls.call("crkr/@v1/task/a/rpc/report", {"trials": b"0" * MAX_MESSAGE_BYTES})
    assert peer.queries == []


def test_work_that_takes_long_is_asked_for_once(make_peer: MakePeer) -> None:
    peer = make_peer(["hold"])

    def answer_late() -> None:
        query = peer.held[0]
        with query:
            query.reply(str(query.key_expr), msgpack.packb({"accepted": False}))

    with Client(peer.endpoint, timeout_s=20) as client, ThreadPoolExecutor(1) as pool:
        asked = pool.submit(client.task("a").refit)
        assert peer.heard.wait(60)
        late = threading.Timer(2.0, answer_late)  # longer than two ordinary attempts
        late.start()
        assert asked.result() == {"accepted": False}
        late.join()
    assert len(peer.queries) == 1


class _Seen(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.event = threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        if "trying again" in record.getMessage():
            self.event.set()


def test_a_client_may_be_there_before_its_server(make_peer: MakePeer, free_port: int) -> None:
    retrying = _Seen()
    logger = logging.getLogger("crkr.client.network.zenoh_transport")
    logger.addHandler(retrying)
    logger.setLevel(logging.INFO)
    try:
        with Client(f"tcp/127.0.0.1:{free_port}", timeout_s=20) as client, ThreadPoolExecutor(1) as pool:
            asked = pool.submit(client.info)
            assert retrying.event.wait(60)
            make_peer([INFO])
            assert asked.result() == INFO
    finally:
        logger.removeHandler(retrying)
        logger.setLevel(logging.NOTSET)


def test_a_session_outlives_its_server(make_peer: MakePeer) -> None:
    first = make_peer([INFO])
    with Client(first.endpoint, timeout_s=20) as client:
        client.info()
        first.__exit__()
        second = make_peer([{**INFO, "server_id": "the next"}])
        assert client.info()["server_id"] == "the next"
        assert second.queries
        second.__exit__()


def test_threads_share_a_client_and_each_gets_its_own_answer(make_peer: MakePeer) -> None:
    peer: Any = None
    peer = make_peer(lambda number: msgpack.unpackb(peer.queries[number][1]))
    with rpc(peer.endpoint, timeout_s=20) as calls, ThreadPoolExecutor(8) as pool:
        asked = [{"states": number} for number in range(400)]
        answered = pool.map(lambda message: calls.call("crkr/@v1/task/a/rpc/predict", message), asked)
        assert list(answered) == asked


def test_closing_ends_a_call_in_progress(make_peer: MakePeer) -> None:
    peer = make_peer(["hold"])
    client = Client(peer.endpoint, timeout_s=60)
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(client.info)
        assert peer.heard.wait(60)
        client.close()
        with pytest.raises(Unavailable, match="closed"):
            asked.result(timeout=60)
    with pytest.raises(Unavailable, match="closed"):
        client.info()
    client.close()


@pytest.mark.parametrize("timeout_s", [0, -1, float("nan"), float("inf"), "5"])
def test_a_deadline_is_a_positive_number(timeout_s: Any) -> None:
    with pytest.raises(Invalid, match="timeout_s"):
        Client(timeout_s=timeout_s)


def test_a_publication_without_a_connection_is_dropped_without_a_word(free_port: int) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}", timeout_s=0.2) as client:
        client.task("a").publish("trial", {"cost": 0.1})
