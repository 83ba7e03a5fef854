"""A worker's token is there while it lives, and its id is its own."""

import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from uuid import uuid4

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


def test_one_of_several_claims_at_the_same_time_gets_the_id(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with ExitStack() as stack:
        clients = [stack.enter_context(Client(peer.endpoint)) for _ in range(3)]
        for name in ("a", "b", "c"):
            ready, found = threading.Barrier(len(clients)), list[Any]()

            def announce(
                client: Client, name: str = name, ready: threading.Barrier = ready, found: list[Any] = found
            ) -> None:
                ready.wait(60)
                try:
                    found.append(stack.enter_context(client.task("throw").announce(name, timeout_s=0.5)))
                except Conflict as refusal:
                    found.append(refusal)

            threads = [threading.Thread(target=announce, args=(client,)) for client in clients]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60)
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


@pytest.fixture
def throw(shared_endpoint: str) -> str:
    """A task of the test's own on a real server."""
    axis = [{"name": "x", "low": 0.0, "high": 1.0}]
    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.wait_until_ready(60.0)
        return client.create_task({"name": f"throw-{uuid4()}", "state": axis, "goal": axis}).name


def state_when_gone(endpoint: str, task: str, worker: str) -> str:
    """How the server sees a worker that is alive no longer."""
    with Client(endpoint) as client:
        while True:  # the pytest timeout is the deadline
            workers = client.task(task).status()["workers"]
            if gone := [one["state"] for one in workers if one["id"] == worker and one["state"] != "alive"]:
                return str(gone[0])


@pytest.mark.parametrize("first", ["presence", "client"])
def test_a_worker_has_left_whichever_is_closed_first(first: str, shared_endpoint: str, throw: str) -> None:
    client = Client(shared_endpoint, timeout_s=30.0)
    presence = client.task(throw).announce("w")
    one, other = (presence, client) if first == "presence" else (client, presence)
    one.close()
    other.close()
    assert state_when_gone(shared_endpoint, throw, "w") == "left"


def test_every_worker_of_a_client_has_left_with_it(shared_endpoint: str, throw: str) -> None:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        kept = [client.task(throw).announce(name) for name in ("a", "b", "c")]
    assert [state_when_gone(shared_endpoint, throw, one.worker_id) for one in kept] == ["left"] * 3


FORGETFUL = """
import os, sys
from crkr.client import Client
client = Client(sys.argv[1])
presence = client.task(sys.argv[2]).announce("w")
while not client.task(sys.argv[2]).status()["workers"]:
    pass
{}
"""


@pytest.mark.parametrize(
    ("ending", "state"), [("sys.exit(3)", "left"), ("raise KeyError", "left"), ("os._exit(3)", "lost")]
)
def test_a_process_that_ends_without_closing_has_left_unless_it_was_cut_off(
    ending: str, state: str, shared_endpoint: str, throw: str
) -> None:
    command = [sys.executable, "-c", FORGETFUL.format(ending), shared_endpoint, throw]
    subprocess.run(command, stderr=subprocess.DEVNULL, timeout=30, check=False)
    assert state_when_gone(shared_endpoint, throw, "w") == state


@pytest.mark.parametrize("worker", ["", "a/b", "a*", "a b", "-a", "$", "x" * 128, None])
def test_an_id_that_cannot_stand_in_a_key_is_refused(free_port: int, worker: Any) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}") as client, pytest.raises(Invalid, match="worker id"):
        client.task("throw").announce(worker)


def test_announcing_without_a_server_ends_at_the_deadline(free_port: int) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}") as client, pytest.raises(Unavailable):
        client.task("throw").announce("w", timeout_s=0.2)
