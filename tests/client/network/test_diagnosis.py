"""What stands in the way of a connection is named: a part of the endpoint, the host, or what listens there."""

import json
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from crkr.client import Client
from crkr.client.network.config import Connection
from crkr.client.network.diagnosis import fault_in, obstacle
from crkr.protocol import Invalid, Unavailable

PATIENCE_S = 20.0


@pytest.mark.parametrize(
    ("endpoint", "part"),
    [
        ("localhost:7447", "form"),
        ("tcp/", "form"),
        ("tcp/local host:7447", "form"),
        ("http/localhost:7447", "protocol 'http' is unknown"),
        ("TCP/localhost:7447", "form"),
        ("tcp/localhost", "port is missing"),
        ("tcp/localhost:", "port is missing"),
        ("tcp/[::1]", "port is missing"),
        ("tcp/localhost:http", "no number"),
        ("tcp/localhost:0", "1 to 65535"),
        ("tcp/localhost:65536", "1 to 65535"),
        ("tls/:7447", "host is missing"),
    ],
)
def test_the_part_of_an_endpoint_that_is_wrong_is_named(
    endpoint: str, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(Invalid, match=part):
        Connection.choose(endpoint, None)
    monkeypatch.setenv("CRKR_CONNECT", endpoint)
    with pytest.raises(Invalid, match=f"endpoint in CRKR_CONNECT is .*{part}"):
        Connection.choose(None, None)


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tls/learner.lab:65535",
        "tcp/a-host:1?prio=1",
        "udp/h:1#iface=eth0",
        "unixsock-stream/crkr.socket",
        "serial//dev/ttyUSB0#baudrate=9600",
    ],
)
def test_what_zenoh_can_connect_to_is_let_through(endpoint: str) -> None:
    assert fault_in(endpoint) is None
    Connection.choose(endpoint, None)


def doctor(endpoint: str) -> str:
    """The last line of `crkr doctor`."""
    command = [sys.executable, "-m", "crkr.client", "doctor", "--connect", endpoint, "--timeout", "1.5"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=60, check=False)
    assert done.returncode == 1
    return done.stdout.splitlines()[-1]


def told(endpoint: str) -> str:
    """What a call says at its deadline."""
    with Client(endpoint, timeout_s=1.5) as client, pytest.raises(Unavailable) as caught:
        client.info()
    return caught.value.message


@contextmanager
def saying(greeting: bytes) -> Iterator[int]:
    """A port where something says the same to everyone."""
    over = threading.Event()

    def serve(listener: socket.socket) -> None:
        while not over.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            with connection:
                connection.settimeout(0.5)
                try:
                    connection.recv(4096)
                    connection.sendall(greeting)
                except OSError:
                    continue

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(0.1)
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            over.set()
            thread.join()


@pytest.mark.parametrize(
    ("greeting", "name"),
    [(b"HTTP/1.1 400 Bad Request\r\n\r\n", "a web server"), (b"SSH-2.0-OpenSSH_9\r\n", "an SSH server")],
)
def test_something_that_does_not_speak_zenoh_is_named(greeting: bytes, name: str) -> None:
    with saying(greeting) as port:
        for words in (told(f"tcp/127.0.0.1:{port}"), doctor(f"tcp/127.0.0.1:{port}")):
            assert f"what listens at 127.0.0.1:{port} is {name} and does not speak Zenoh" in words


def test_a_host_without_an_address_is_named() -> None:
    for words in (told("tcp/no-such-host.invalid:7447"), doctor("tcp/no-such-host.invalid:7447")):
        assert "the host 'no-such-host.invalid' has no address" in words


def test_the_doctor_names_an_endpoint_without_a_listener(free_port: int) -> None:
    assert f"nobody listens at 127.0.0.1:{free_port}" in doctor(f"tcp/127.0.0.1:{free_port}")


def test_a_zenoh_router_that_is_no_server_is_named(free_port: int) -> None:
    """As ROS 2's, which listens on the same port."""
    config, endpoint = zenoh.Config(), f"tcp/127.0.0.1:{free_port}"
    settings: dict[str, Any] = {"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config):
        for words in (told(endpoint), doctor(endpoint)):
            assert "a Zenoh router where no crkr server shows" in words


def test_a_server_that_is_there_is_no_obstacle(shared_endpoint: str) -> None:
    with Client(shared_endpoint, timeout_s=PATIENCE_S) as client:
        client.info()
    assert obstacle(shared_endpoint, Connection.choose(shared_endpoint, None).zenoh(1.0), PATIENCE_S) is None
