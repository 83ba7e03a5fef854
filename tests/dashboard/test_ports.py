import socket
from collections.abc import Iterator

import pytest

from crkr.dashboard.ports import choose_port
from crkr.protocol import Invalid

HOST = "127.0.0.1"


@pytest.fixture
def taken() -> Iterator[int]:
    with socket.create_server((HOST, 0)) as listener:
        port: int = listener.getsockname()[1]
        yield port


def test_a_free_port_is_taken_as_it_is(free_port: int) -> None:
    assert choose_port(HOST, free_port, 1) == free_port
    assert choose_port(HOST, None, free_port) == free_port


def test_the_next_free_port_stands_in_for_a_taken_default(taken: int) -> None:
    chosen = choose_port(HOST, None, taken)
    assert chosen > taken
    with socket.create_server((HOST, chosen)):
        pass


def test_a_taken_port_that_was_asked_for_is_refused(taken: int) -> None:
    with pytest.raises(Invalid, match=f"port {taken} on {HOST} is taken"):
        choose_port(HOST, taken, 1)
