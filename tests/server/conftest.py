"""A client that shares nothing with ours: plain Zenoh and msgpack, written from the protocol's description."""

import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from uuid import UUID, uuid4

import msgpack
import numpy as np
import pytest
import zenoh

Ask = Callable[..., dict[str, Any]]

PREFIX = "crkr/@v1/"
PATIENCE_S = 60.0

REACH = {
    "name": "reach",
    "state": [
        {"name": "x", "unit": "m", "low": 0.0, "high": 1.0, "lengthscale": 0.2},
        {"name": "y", "unit": "m", "low": -1.0, "high": 1.0, "lengthscale": 0.4},
    ],
    "goal": [{"name": f"joint {joint}", "unit": "rad", "low": -2.0, "high": 2.0, "scale": 1.0} for joint in range(3)],
    "budget": 20,
    "seed": 7,
}


def open_plain(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for name, value in {
        "mode": '"client"',
        "connect/endpoints": f'["{endpoint}"]',
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
    }.items():
        config.insert_json5(name, value)
    return zenoh.open(config)


def decoded(reply: zenoh.Reply) -> dict[str, Any]:
    """The reply's map; an error reply as {"error": its map}."""
    if reply.ok is not None:
        message: dict[str, Any] = msgpack.unpackb(reply.ok.payload.to_bytes())
        return message
    assert reply.err is not None
    payload = reply.err.payload.to_bytes()
    assert payload != b"Timeout", "no answer in time"
    assert str(reply.err.encoding) == "application/msgpack;crkr.error.v1"
    return {"error": msgpack.unpackb(payload)}


@pytest.fixture
def plain() -> Iterator[Callable[[str], zenoh.Session]]:
    """Opens plain sessions; closed at the end of the test."""
    with ExitStack() as stack:
        yield lambda endpoint: stack.enter_context(open_plain(endpoint))


@pytest.fixture
def connect(plain: Callable[[str], zenoh.Session]) -> Callable[[str], Ask]:
    """`ask = connect(endpoint)`; `ask("rpc/info", {...})` returns the reply's map."""

    def connected(endpoint: str) -> Ask:
        session = plain(endpoint)

        def ask(
            key: str, message: Any = None, *, payload: bytes | None = None, encoding: str | None = None
        ) -> dict[str, Any]:
            replies = session.get(
                PREFIX + key,
                zenoh.handlers.FifoChannel(4),
                payload=msgpack.packb(message or {}) if payload is None else payload,
                encoding=encoding,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=PATIENCE_S,
            )
            return decoded(replies.recv())

        return ask

    return connected


@pytest.fixture(scope="session")
def shared_endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """One server for all tests that leave it as they found it, their own task aside."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    data = tmp_path_factory.mktemp("shared") / "data"
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(data)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "listening on" in process.stderr.readline()
        drain = threading.Thread(target=process.stderr.read)
        drain.start()
        yield endpoint
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0
        drain.join()


@pytest.fixture
def ask(shared_endpoint: str, connect: Callable[[str], Ask]) -> Ask:
    """Asks the shared server; every test has a task `reach` of its own, under a name that no other test uses."""
    connected, name = connect(shared_endpoint), f"reach-{uuid4()}"

    def asking(key: str, message: Any = None, **options: Any) -> dict[str, Any]:
        if key == "rpc/create_task" and message is not None and message["name"] == "reach":
            message = {**message, "name": name}
        return connected(key.replace("/reach/", f"/{name}/"), message, **options)

    assert asking("rpc/create_task", REACH)["created"] is True
    return asking


@pytest.fixture
def make_trial() -> Callable[..., dict[str, Any]]:
    """Trials of the task `reach` as wire maps, drawn by a number."""

    def make(number: int, **changes: Any) -> dict[str, Any]:
        rng = np.random.default_rng(number)
        trial = {
            "id": UUID(int=number + 1).bytes,
            "state": rng.uniform([0, -1], [1, 1]).tolist(),
            "goal": rng.uniform(-1, 1, 3).tolist(),
            "cost": float(rng.uniform(0, 0.9)),
            "success": True,
            "kind": "trial",
        }
        return {**trial, **changes}

    return make


@pytest.fixture
def new_id() -> Callable[[], bytes]:
    """Random ids."""
    return lambda: uuid4().bytes


@pytest.fixture
def reach() -> dict[str, Any]:
    """The specification of the task `reach`."""
    return dict(REACH)


@pytest.fixture
def numbers() -> Callable[[Any], np.ndarray[Any, Any]]:
    """Reads an array map."""
    return lambda wire: np.frombuffer(wire["data"], wire["dtype"]).reshape(wire["shape"])
