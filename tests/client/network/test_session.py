"""A session whose connection is not read from gives way to another, and what was declared in it moves along."""

from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from typing import Any
from urllib.parse import urlsplit

import msgpack
import pytest
import zenoh
from zenoh_wire import Cable

from crkr.client import Client
from crkr.protocol import Unavailable

MakePeer = Callable[..., Any]
LIVE = "crkr/@v1/task/throw/live/"


@pytest.fixture
def peer(make_peer: MakePeer) -> Any:
    return make_peer([{}])


@pytest.fixture
def cable(peer: Any) -> Iterator[Cable]:
    port = urlsplit(peer.endpoint.replace("tcp/", "tcp://")).port
    assert port is not None
    with closing(Cable(port)) as carried:
        yield carried


def alive(peer: Any, kind: str) -> list[str]:
    replies = peer.session.liveliness().get(LIVE + kind, timeout=1.0)
    return sorted(str(reply.ok.key_expr).removeprefix(LIVE) for reply in replies if reply.ok is not None)


def sessions(peer: Any) -> set[zenoh.ZenohId]:
    return {transport.zid for transport in peer.session.info.transports()}


@pytest.mark.parametrize(
    "deafen", [lambda cable: cable.break_off(silencing=1), Cable.silence], ids=["reconnected", "connected"]
)
def test_calls_are_answered_after_a_connection_lives_and_brings_nothing_back(
    peer: Any, cable: Cable, deafen: Callable[[Cable], None]
) -> None:
    with Client(cable.endpoint, timeout_s=60) as client:
        client.info()
        before = sessions(peer)
        deafen(cable)
        client.info()
        assert not sessions(peer) <= before


def test_calls_of_short_patience_bring_the_next_session_about_too(peer: Any, cable: Cable) -> None:
    with Client(cable.endpoint, timeout_s=2.0) as client:
        client.info()
        cable.silence()
        while True:  # the pytest timeout is the deadline
            with suppress(Unavailable):
                client.info()
                break


def test_another_attempt_is_made_where_the_next_session_is_not_heard_either(peer: Any, cable: Cable) -> None:
    with Client(cable.endpoint, timeout_s=60) as client:
        client.info()
        cable.break_off(silencing=2)
        client.info()


def test_the_session_stays_where_the_server_is_slow_and_the_router_answers(make_peer: MakePeer) -> None:
    peer = make_peer([{}, "silence", "silence", "silence", {}])
    with Client(peer.endpoint, timeout_s=60) as client:
        client.info()
        before = sessions(peer)
        client.info()
        assert len(peer.queries) == 5
        assert sessions(peer) == before


def test_workers_roles_and_subscriptions_move_to_the_next_session(peer: Any, cable: Cable) -> None:
    with Client(cable.endpoint, timeout_s=60) as client, client.task("throw").announce("w") as presence:
        role = client.take_role("throw", "judge")
        assert role is not None
        subscription = client.task("throw").subscribe()
        while not (held := alive(peer, "role/judge/*")) or alive(peer, "worker/*") != ["worker/w"]:
            pass
        told = peer.session.liveliness().declare_subscriber(LIVE + "worker/*", zenoh.handlers.FifoChannel(64))
        before = sessions(peer)
        cable.break_off(silencing=1)
        client.info()
        while not sessions(peer).isdisjoint(before):
            pass
        assert (alive(peer, "worker/*"), alive(peer, "role/judge/*")) == (["worker/w"], held)
        assert role.is_mine()
        for number in range(3):
            message = msgpack.packb({"number": number})
            peer.session.put("crkr/@v1/task/throw/pub/model", message, encoding="application/msgpack")
        received = [subscription.receive(10.0) for _ in range(3)]
        assert [message and message[1]["number"] for message in received] == [0, 1, 2]
        kinds = [sample.kind for sample in iter(told.try_recv, None)]
        assert kinds[-1] == zenoh.SampleKind.PUT  # or a server would take the worker for lost
        presence.close()
        role.close()
        subscription.close()
        assert subscription.closed
        while alive(peer, "*/**"):
            pass
