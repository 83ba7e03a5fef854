"""A session whose connection is not read from gives way to another, and what was declared in it moves along."""

import gc
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from typing import Any
from urllib.parse import urlsplit

import msgpack
import pytest
import zenoh
from zenoh_wire import Cable

from crkr.client import Client
from crkr.client.network.config import Connection
from crkr.client.network.subscription import Subscription
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.protocol import Unavailable, pack, rpc_key, task_key

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


@pytest.mark.parametrize(("timeout_s", "patient"), [(0.4, False), (1.0, True)])
def test_calls_of_few_attempts_bring_the_next_session_about_too(
    timeout_s: float, patient: bool, peer: Any, cable: Cable
) -> None:
    def ask() -> bytes:
        return transport.query(rpc_key("info"), "info", pack({}), time.monotonic() + timeout_s, patient=patient)

    with ZenohTransport(Connection.choose(cable.endpoint, None)) as transport:
        transport.connect(time.monotonic() + 60)
        cable.silence()
        while True:  # the pytest timeout is the deadline
            with suppress(Unavailable):
                assert ask()
                break


@pytest.mark.parametrize("declare", ["announce", "take_role", "is_mine"])
def test_what_declares_tokens_brings_the_next_session_about_too(declare: str, peer: Any, cable: Cable) -> None:
    with Client(cable.endpoint, timeout_s=60) as client:
        client.info()
        role = client.take_role("throw", "judge")
        assert role is not None
        before = sessions(peer)
        cable.silence()
        if declare == "announce":
            with client.task("throw").announce("w", timeout_s=60):
                while alive(peer, "worker/*") != ["worker/w"]:
                    pass
        elif declare == "take_role":
            with client.take_role("throw", "scribe", timeout_s=60) or pytest.fail("it is free"):
                while not alive(peer, "role/scribe/*"):
                    pass
        while not sessions(peer).isdisjoint(before):
            assert role.is_mine()


def test_the_session_that_takes_over_may_be_another_servers(peer: Any, cable: Cable) -> None:
    with Client(f"{cable.endpoint},{peer.endpoint}", timeout_s=60) as client:
        client.info()
        cable.silence(coming=1000)
        client.info()
        assert len(peer.queries) > 1


def test_nothing_moves_to_a_session_that_is_not_answered(peer: Any, cable: Cable) -> None:
    with Client(cable.endpoint, timeout_s=60) as client, client.task("throw").announce("w"):
        before = set(sessions(peer))
        told = peer.session.liveliness().declare_subscriber(LIVE + "worker/*", zenoh.handlers.FifoChannel(64))
        cable.silence(coming=2)
        client.info()
        while not sessions(peer).isdisjoint(before):
            pass
        assert alive(peer, "worker/*") == ["worker/w"]
        assert all(sample.kind == zenoh.SampleKind.PUT for sample in iter(told.try_recv, None))


def test_what_cannot_move_leaves_the_others_alone(peer: Any, cable: Cable) -> None:
    class Stuck:
        def move(self, session: zenoh.Session) -> object:
            raise RuntimeError(f"no thread for {session}")

    with ZenohTransport(Connection.choose(cable.endpoint, None)) as transport:
        session, stuck = transport.connect(time.monotonic() + 60), [Stuck() for _ in range(8)]
        presence = transport.announce("throw", "w", time.monotonic() + 60)
        for one in stuck:
            transport.session.keep(one, session)
        cable.silence()
        transport.query(rpc_key("info"), "info", pack({}), time.monotonic() + 60)
        while not session.is_closed():
            pass
        assert alive(peer, "worker/*") == ["worker/w"]
        presence.close()


def test_a_subscription_that_is_closed_while_it_moves_stays_closed(peer: Any) -> None:
    class Next:
        def declare_subscriber(self, *arguments: Any) -> Any:
            subscription.close()
            return session.declare_subscriber(*arguments)

    with ZenohTransport(Connection.choose(peer.endpoint, None)) as transport:
        session = transport.connect(time.monotonic() + 60)
        subscription = Subscription(session, "throw", ["model"], 8)
        subscription.move(Next())  # type: ignore[arg-type]  # it stands in for Zenoh's
        assert subscription.closed


def test_a_forgotten_client_ends_though_its_connection_is_being_checked(peer: Any, cable: Cable) -> None:
    client = Client(cable.endpoint, timeout_s=3.0)
    client.info()
    cable.silence(coming=1000)
    with pytest.raises(Unavailable):
        client.info()
    forgotten = weakref.ref(client)
    del client
    while forgotten() is not None or sessions(peer):
        gc.collect()


@pytest.mark.campaign
def test_a_long_message_arrives_on_a_slow_link_though_others_time_out_behind_it(peer: Any) -> None:
    port = urlsplit(peer.endpoint.replace("tcp/", "tcp://")).port
    assert port is not None
    with closing(Cable(port, 50_000.0)) as cable, ZenohTransport(Connection.choose(cable.endpoint, None)) as transport:
        transport.connect(time.monotonic() + 60)
        ended = threading.Event()

        def send() -> None:
            key = task_key("throw", "report")
            transport.query(key, "report", bytes(800_000), time.monotonic() + 120, patient=True)
            ended.set()

        thread = threading.Thread(target=send)
        thread.start()
        while thread.is_alive():
            with suppress(Unavailable):
                transport.query(rpc_key("info"), "info", pack({}), time.monotonic() + 5)
        assert ended.is_set()


CONNECTING = """
import asyncio, sys
from crkr.client import AsyncClient
client = AsyncClient("tcp/127.0.0.1:9")  # nobody listens
async def main():
    try:
        await asyncio.wait_for(client.info(timeout_s=20), float(sys.argv[1]))
    except asyncio.TimeoutError:
        pass
asyncio.run(main())
"""


def test_a_process_may_end_while_a_thread_of_it_connects() -> None:
    patience = [f"{1.35 + 0.05 * number}" for number in range(6)]
    commands = [[sys.executable, "-c", CONNECTING, one] for one in patience]
    started = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for command in commands]
    ends = [(process.communicate(timeout=60)[1], process.returncode) for process in started]
    assert ends == [("", 0)] * len(started)


def test_the_session_stays_where_the_server_is_slow_and_the_router_answers(make_peer: MakePeer) -> None:
    peer = make_peer([{}, "silence", "silence", "silence", {}])
    with Client(peer.endpoint, timeout_s=60) as client:
        client.info()
        before = sessions(peer)
        client.info()
        assert len(peer.queries) == 5
        assert sessions(peer) == before


@pytest.mark.parametrize("broken", [False, True])
def test_what_a_connection_that_brings_nothing_back_carried_moves_to_another(
    broken: bool, peer: Any, cable: Cable
) -> None:
    with Client(cable.endpoint, timeout_s=60) as client, client.task("throw").announce("w") as presence:
        role = client.take_role("throw", "judge")
        assert role is not None
        subscription = client.task("throw").subscribe()
        while not (held := alive(peer, "role/judge/*")) or alive(peer, "worker/*") != ["worker/w"]:
            pass
        told = peer.session.liveliness().declare_subscriber(LIVE + "worker/*", zenoh.handlers.FifoChannel(64))
        before = sessions(peer)
        if broken:
            cable.break_off(silencing=1)
        else:
            cable.silence()
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
        assert kinds[-1:] in ([], [zenoh.SampleKind.PUT])  # or a server would take the worker for lost
        assert broken or zenoh.SampleKind.DELETE not in kinds
        presence.close()
        role.close()
        subscription.close()
        assert subscription.closed
        while alive(peer, "*/**"):
            pass
