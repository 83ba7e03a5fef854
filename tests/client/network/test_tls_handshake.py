"""No false refusals: a client that reads one stops trying. Real refusals are in the tests of the system."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh

from crkr.client.network.tls_handshake import certificate_end, refusal

Listen = Callable[[bytes | None], str]


@contextmanager
def listening(greeting: bytes | None) -> Iterator[str]:
    """Takes one connection, says something to whatever it hears, and ends it; None: says nothing and holds it."""
    over = threading.Event()

    def serve(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            connection.recv(4096)
            if greeting is None:
                over.wait()
            else:
                connection.sendall(greeting)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(10.0)
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        yield f"127.0.0.1:{listener.getsockname()[1]}"
        over.set()
        thread.join()


@pytest.fixture
def listen() -> Iterator[Listen]:
    """Addresses of such listeners."""
    with ExitStack() as stack:
        yield lambda greeting: stack.enter_context(listening(greeting))


def config(**tls: object) -> zenoh.Config:
    made = zenoh.Config()
    for name, value in tls.items():
        made.insert_json5(f"transport/link/tls/{name}", str(value))
    return made


@pytest.mark.parametrize("greeting", [b"", None], ids=["that ends it", "that says nothing"])
@pytest.mark.parametrize("protocol", ["tls", "tcp"])
def test_a_connection_that_comes_to_nothing_is_no_refusal(
    listen: Listen, protocol: str, greeting: bytes | None
) -> None:
    assert refusal(f"{protocol}/{listen(greeting)}", config(), 0.2) is None


@pytest.mark.parametrize("protocol", ["tls", "tcp", "udp"])
def test_an_endpoint_without_a_listener_is_no_refusal(free_port: int, protocol: str) -> None:
    assert refusal(f"{protocol}/127.0.0.1:{free_port}", config(), 1.0) is None
    assert certificate_end(f"{protocol}/127.0.0.1:{free_port}", config(), 1.0) is None


def test_something_else_than_tls_is_told_as_such(listen: Listen) -> None:
    address = listen(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    assert refusal(f"tls/{address}", config(), 5.0) == "what listens there does not speak TLS"


def test_a_key_that_cannot_be_read_is_told_before_anything_is_tried(tmp_path: Path) -> None:
    broken = tmp_path / "client.pem"
    broken.write_text("no certificate")
    files = config(enable_mtls="true", connect_certificate=f'"{broken}"', connect_private_key=f'"{broken}"')
    assert f"{broken} or its key cannot be used" in str(refusal("tls/127.0.0.1:1", files, 1.0))


def test_a_name_look_up_without_an_answer_ends_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    over, late = threading.Event(), threading.Event()

    def look_up(*_: object, **__: object) -> list[object]:
        if not over.wait(20.0):
            late.set()
        raise socket.gaierror("no name server")

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    try:
        assert refusal("tls/learner.lab:7447", config(), 0.1) is None
        assert certificate_end("tls/learner.lab:7447", config(), 0.1) is None
        assert not late.is_set()
    finally:
        over.set()


def test_what_is_no_name_is_no_refusal() -> None:
    assert refusal("tls/learner..lab:7447", config(), 1.0) is None
