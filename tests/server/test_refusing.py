"""Refusals are paced, and yet nobody waits for one longer than an attempt."""

from collections.abc import Callable

import pytest
import zenoh

from crkr.protocol import task_key
from crkr.server.lane import busy
from crkr.server.latency import Latencies
from crkr.server.refusing import Refuser
from crkr.server.request import Request
from crkr.server.session import open_session

FIRST_ATTEMPT_S = 0.5
PAUSE_S = 0.004


@pytest.mark.parametrize("count", [300, 2000])
def test_the_last_of_many_is_told_within_a_first_attempt(
    count: int, free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    key, endpoint = task_key("reach", "explain"), f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable(key, zenoh.handlers.FifoChannel(count), complete=True)
        asking = plain(endpoint)
        waiting = [asking.get(key, zenoh.handlers.FifoChannel(1), timeout=60.0) for _ in range(count)]
        refuser = Refuser()
        for _ in waiting:
            refuser.add(Request(queries.recv(), Latencies()), busy("explain"))
        told = pauses = 0
        while told < count:
            batch = refuser._take()
            for request, error in batch:
                request.fail(error)
            told, pauses = told + len(batch), pauses + 1
        assert pauses * PAUSE_S < 0.75 * FIRST_ATTEMPT_S
        assert len(batch) <= told / pauses + 1  # evenly, not all at the end
        assert all(replies.recv().err is not None for replies in waiting)
