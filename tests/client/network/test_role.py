"""A role is one process's at a time, and free when that lets go of it or ends."""

import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from uuid import UUID

import pytest

from crkr.client import Client, Role
from crkr.client.network.config import Connection
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.protocol import Invalid, Unavailable
from crkr.protocol.keys import live_role_key

MakePeer = Callable[..., Any]


def test_a_role_is_one_process_s_until_it_is_closed(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as one, Client(peer.endpoint) as other:
        role = one.take_role("throw", "judge")
        assert role is not None
        assert role.is_mine()
        assert other.take_role("throw", "judge") is None
        role.close()
        role.close()
        assert not role.is_mine()
        taken = other.take_role("throw", "judge")
        assert taken is not None


def test_other_roles_and_other_tasks_are_not_affected(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client:
        kept = [client.take_role(*names) for names in (("a", "judge"), ("b", "judge"), ("a", "cook"))]
        assert None not in kept


def test_a_role_is_free_again_when_its_client_is_closed(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as other:
        with Client(peer.endpoint) as one:
            role = one.take_role("throw", "judge")
        while (taken := other.take_role("throw", "judge")) is None:
            pass  # the pytest timeout is the deadline
        assert taken.is_mine()
        assert role is not None
        role.close()


def test_one_of_several_claims_at_the_same_time_gets_the_role(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with ExitStack() as stack:
        clients = [stack.enter_context(Client(peer.endpoint)) for _ in range(3)]
        for name in ("a", "b", "c"):
            ready, found = threading.Barrier(len(clients)), list[Role | None]()

            def take(
                client: Client, name: str = name, ready: threading.Barrier = ready, found: list[Any] = found
            ) -> None:
                ready.wait(60)
                found.append(client.take_role("throw", name))

            threads = [threading.Thread(target=take, args=(client,)) for client in clients]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60)
            assert sum(role is not None for role in found) == 1
            assert len(found) == 3


def test_of_two_holders_of_a_role_one_is_told_to_give_it_up(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    keys = [live_role_key("throw", "judge", str(UUID(int=number))) for number in (1, 2)]
    transports = [ZenohTransport(Connection.choose(peer.endpoint, None)) for _ in keys]
    sessions = [transport.connect(time.monotonic() + 5.0) for transport in transports]
    pattern = live_role_key("throw", "judge", "*")
    roles = [
        Role(session.liveliness().declare_token(key), key, session, pattern, transport.session)
        for key, session, transport in zip(keys, sessions, transports, strict=True)
    ]
    while roles[1].is_mine():
        pass  # the pytest timeout is the deadline: a declaration takes milliseconds to arrive
    assert roles[0].is_mine()
    roles[0].close()
    while not roles[1].is_mine():
        pass
    for transport in transports:
        transport.close()


def test_while_the_server_is_held_or_gone_no_role_is_taken(start_server: Callable[..., Any]) -> None:
    server = start_server()
    with Client(server.endpoint, timeout_s=1.0) as client:
        client.info(timeout_s=20.0)
        server.process.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises(Unavailable):
                client.take_role("throw", "judge")
        finally:
            server.process.send_signal(signal.SIGCONT)
        server.process.terminate()
        server.process.wait(60)
        with pytest.raises(Unavailable):
            client.take_role("throw", "judge")


def test_a_role_has_a_name(free_port: int) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}") as client:
        with pytest.raises(Invalid):
            client.take_role("throw", "the judge")
        with pytest.raises(Invalid):
            client.take_role("Throw", "judge")
