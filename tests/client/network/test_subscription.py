"""Publications reach a reader in order, and a slow reader loses the oldest and nothing else."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from crkr.client import Client, Subscription
from crkr.protocol import MAX_TELEMETRY_BYTES, Invalid

MakePeer = Callable[..., Any]
PUB = "crkr/@v1/task/throw/pub/"
PATIENCE_S = 10.0


def publish(session: zenoh.Session, topic: str, message: object, encoding: str = "application/msgpack") -> None:
    payload = message if isinstance(message, bytes) else msgpack.packb(message)
    session.put(PUB + topic, payload, encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK)


def read_until(subscription: Subscription, last: int) -> list[tuple[str, dict[str, Any]]]:
    """Everything up to the message numbered `last`."""
    received: list[tuple[str, dict[str, Any]]] = []
    while not received or received[-1][1].get("number") != last:
        message = subscription.receive(PATIENCE_S)
        assert message is not None, f"nothing more after {received[-3:]}"
        received.append(message)
    return received


def connected(client: Client, peer: Any) -> Subscription:
    """A subscription that is known to the router: a first message has come through."""
    subscription = client.task("throw").subscribe()
    for _ in range(200):
        publish(peer.session, "model", {"number": -1})
        if subscription.receive(0.05) is not None:
            break
    publish(peer.session, "model", {"number": -2})
    read_until(subscription, -2)
    return subscription


def test_publications_of_all_topics_arrive_in_order_with_arrays(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, connected(client, peer) as subscription:
        for number in range(50):
            publish(peer.session, ("trial", "evaluation", "model")[number % 3], {"number": number})
        received = read_until(subscription, 49)
        assert [message["number"] for _, message in received] == list(range(50))
        assert [topic for topic, _ in received[:3]] == ["trial", "evaluation", "model"]
        client.task("throw").publish("trial", {"number": 50, "state": np.array([1.5, 2.5])})
        [(topic, message)] = read_until(subscription, 50)
        assert topic == "trial"
        np.testing.assert_array_equal(message["state"], [1.5, 2.5])


def test_what_cannot_be_read_is_skipped(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, connected(client, peer) as subscription:
        publish(peer.session, "trial", b"\xc1")
        publish(peer.session, "trial", {"number": 1}, "application/msgpack;crkr.trial.v2")
        publish(peer.session, "trial", {"a": {"shape": [9], "dtype": "<f8", "data": b""}})
        publish(peer.session, "rumour", {"number": 2})
        publish(peer.session, "trial", {"number": 3})
        assert read_until(subscription, 3) == [("trial", {"number": 3})]


@pytest.mark.parametrize("depth", [65, 400, 1000])
def test_a_publication_that_is_nested_deep_is_skipped_and_counted(make_peer: MakePeer, depth: int) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, connected(client, peer) as subscription:
        publish(peer.session, "trial", b"\x81\xa1a" + b"\x91" * depth + b"\xc0")
        publish(peer.session, "trial", {"number": 3})
        assert read_until(subscription, 3) == [("trial", {"number": 3})]
        assert subscription.skipped == 1


def test_a_publication_beyond_the_limit_of_telemetry_is_skipped(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, connected(client, peer) as subscription:
        publish(peer.session, "trial", {"number": 1, "picture": bytes(MAX_TELEMETRY_BYTES)})
        publish(peer.session, "trial", {"number": 3})
        assert read_until(subscription, 3) == [("trial", {"number": 3})]


def test_a_slow_reader_holds_a_bounded_number_of_bytes(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, connected(client, peer) as subscription:
        for number in range(24):
            publish(peer.session, "model", {"number": number, "ids": bytes(4_000_000)})
        while subscription.dropped < 8:  # its thread takes them meanwhile
            client.info()
        assert [message["number"] for _, message in read_until(subscription, 23)] == list(range(8, 24))


def test_a_slow_reader_keeps_the_newest_and_knows_what_it_lost(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with (
        Client(peer.endpoint) as client,
        connected(client, peer) as witness,
        client.task("throw").subscribe(["trial"], capacity=4) as slow,
    ):
        while slow.receive(0.05) is None:
            publish(peer.session, "trial", {"number": -3})
        publish(peer.session, "trial", {"number": -4})
        read_until(slow, -4)
        for number in range(20):
            publish(peer.session, "trial", {"number": number})
        read_until(witness, 19)
        while slow.dropped < 16:  # its thread may run behind the witness's
            assert witness.receive(0.01) is None
        assert [message["number"] for _, message in read_until(slow, 19)] == [16, 17, 18, 19]
        assert slow.dropped == 16


def test_no_publication_in_time_is_none(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, client.task("throw").subscribe() as subscription:
        assert subscription.receive(0.01) is None


def test_closing_wakes_a_reader(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, ThreadPoolExecutor(1) as pool:
        subscription = client.task("throw").subscribe()
        waiting = pool.submit(subscription.receive, 60.0)
        subscription.close()
        assert waiting.result(timeout=PATIENCE_S) is None


def test_a_subscription_goes_on_after_the_server_restarts(make_peer: MakePeer) -> None:
    first = make_peer([{}])
    with Client(first.endpoint, timeout_s=20) as client, connected(client, first) as subscription:
        first.__exit__()
        second = make_peer([{}])
        client.info()
        while (message := subscription.receive(0.05)) is None:
            publish(second.session, "model", {"number": 1})
        assert message == ("model", {"number": 1})
        second.__exit__()


@pytest.mark.parametrize(("topics", "capacity"), [(["rumour"], 4), ([], 4), (["trial"], 0)])
def test_a_subscription_to_nothing_is_refused(make_peer: MakePeer, topics: list[str], capacity: int) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, pytest.raises(Invalid, match="subscribe to"):
        client.task("throw").subscribe(topics, capacity)


def test_telemetry_has_a_topic_and_a_limit(free_port: int) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}") as client:
        with pytest.raises(Invalid, match="the limit is"):
            client.task("throw").publish("trial", {"trace": b"0" * MAX_TELEMETRY_BYTES})
        with pytest.raises(Invalid, match="model"):
            client.task("throw").publish("model", {})


def test_a_publication_above_the_limit_is_left_where_it_arrives(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    with Client(peer.endpoint) as client, connected(client, peer) as subscription:
        publish(peer.session, "trial", {"number": 1, "trace": bytes(MAX_TELEMETRY_BYTES)})
        publish(peer.session, "trial", {"number": 2})
        assert [message["number"] for _, message in read_until(subscription, 2)] == [2]
