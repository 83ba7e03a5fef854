"""A worker's token is there while it lives, and its id is its own."""

import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import pytest
import zenoh

from crkr.client import Client
from crkr.protocol import Conflict, Invalid, Unavailable

MakePeer = Callable[..., Any]
ALL_WORKERS = "crkr/@v1/task/throw/live/worker/*"


def alive(session: zenoh.Session) -> list[str]:
    replies = session.liveliness().get(ALL_WORKERS, timeout=1.0)
    return sorted(str(reply.ok.key_expr).rpartition("/")[2] for reply in replies if reply.ok is not None)


def test_a_worker_is_seen_from_announce_to_the_end_of_the_block(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client:
        with client.task("throw").announce("worker-1") as presence, client.task("throw").announce("worker-2"):
            assert presence.worker_id == "worker-1"
            while alive(peer.session) != ["worker-1", "worker-2"]:
                pass  # the pytest timeout is the deadline: a declaration takes milliseconds to arrive
        while alive(peer.session):
            pass


def test_an_id_in_use_is_refused_and_free_again_afterwards(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as one, Client(peer.endpoint) as other:
        presence = one.task("throw").announce("w")
        with pytest.raises(Conflict, match="'w' is in use"):
            other.task("throw").announce("w", timeout_s=0.3)
        presence.close()
        presence.close()
        other.task("throw").announce("w").close()


def test_of_those_who_want_an_id_at_once_one_gets_it(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with ExitStack() as stack:
        clients = [stack.enter_context(Client(peer.endpoint)) for _ in range(3)]
        for name in ("a", "b", "c"):
            ready, found = threading.Barrier(len(clients)), list[Any]()

            def announce(
                client: Client, name: str = name, ready: threading.Barrier = ready, found: list[Any] = found
            ) -> None:
                ready.wait(10)
                try:
                    found.append(stack.enter_context(client.task("throw").announce(name, timeout_s=0.5)))
                except Conflict as refusal:
                    found.append(refusal)

            threads = [threading.Thread(target=announce, args=(client,)) for client in clients]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(10)
            assert sorted(type(one).__name__ for one in found) == ["Conflict", "Conflict", "Presence"]
        assert alive(peer.session) == ["a", "b", "c"]


def test_a_token_outlives_its_server(make_peer: MakePeer) -> None:
    first = make_peer([{}])
    with Client(first.endpoint, timeout_s=20) as client, client.task("throw").announce("w"):
        first.__exit__()
        second = make_peer([{}])
        client.info()
        while alive(second.session) != ["w"]:
            pass
        second.__exit__()


def test_a_token_may_be_closed_after_its_client(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    client = Client(peer.endpoint)
    with client.task("throw").announce("w"):
        client.close()


@pytest.mark.parametrize("worker", ["", "a/b", "a*", "a b", "-a", "$", "x" * 128, None])
def test_an_id_that_cannot_stand_in_a_key_is_refused(free_port: int, worker: Any) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}") as client, pytest.raises(Invalid, match="worker id"):
        client.task("throw").announce(worker)


def test_announcing_to_nobody_ends_at_the_deadline(free_port: int) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}") as client, pytest.raises(Unavailable):
        client.task("throw").announce("w", timeout_s=0.2)
