"""A lane that rests leaves half of the time to others, as long as more waits than it can do at once."""

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest
import zenoh

from crkr.protocol import task_key
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.queue import Lane
from crkr.server.queries.request import Request
from crkr.server.session import open_session

KEY = task_key("reach", "explain")
Ask = Callable[[], tuple[Request, zenoh.Handler[zenoh.Reply]]]


@pytest.fixture
def ask(free_port: int, plain: Callable[[str], zenoh.Session]) -> Iterator[Ask]:
    """Makes requests of a real client: each with the channel of its reply."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable(KEY, zenoh.handlers.FifoChannel(100), complete=True)
        client = plain(endpoint)

        def make() -> tuple[Request, zenoh.Handler[zenoh.Reply]]:
            replies = client.get(KEY, zenoh.handlers.FifoChannel(1), timeout=20.0)
            return Request(queries.recv(), Latencies()), replies

        yield make


def test_it_rests_as_long_as_it_worked_while_more_waits(ask: Ask) -> None:
    spans: list[tuple[float, float]] = []

    def work(requests: list[Request]) -> None:
        began = time.monotonic()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 50_000)
        spans.append((began, time.monotonic()))
        for request in requests:
            request.reply({"done": True})

    lane: Lane[Request] = Lane("explain", {"explain": 10}, work, rests=True)
    asked = [ask() for _ in range(5)]
    for request, _ in asked:
        assert lane.offer(request) is None
    lane.start()
    for _, replies in asked:
        assert replies.recv().ok is not None
    lane.close(5.0)
    assert len(spans) == 5
    assert all(begins - ended >= ended - began for (began, ended), (begins, _) in pairwise(spans))


def test_the_end_comes_before_the_end_of_a_rest(ask: Ask) -> None:
    working, go_on = threading.Event(), threading.Event()
    spans: list[tuple[float, float]] = []

    def work(requests: list[Request]) -> None:
        began = time.monotonic()
        working.set()
        go_on.wait(20)
        spans.append((began, time.monotonic()))
        for request in requests:
            request.reply({"done": True})

    lane: Lane[Request] = Lane("explain", {"explain": 10}, work, rests=True)
    asked = [ask() for _ in range(3)]
    for request, _ in asked:
        lane.offer(request)
    lane.start()
    assert working.wait(10)
    closing = threading.Thread(target=lane.close, args=(20.0,))
    closing.start()
    closing.join(1.0)  # so long, at least, the lane would rest otherwise
    go_on.set()
    closing.join(10)
    assert not closing.is_alive()
    assert all(replies.recv().ok is not None for _, replies in asked)
    (began, ended), (begins, _), _ = spans
    assert begins - ended < ended - began
