"""One client that asks too much is told so at once, and the others do not notice."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import msgpack
import zenoh

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
OUTSTANDING = 700


def test_beyond_a_full_queue_requests_are_refused_as_busy_while_another_client_is_answered(
    ask: Ask, make_trial: MakeTrial, plain: Callable[[str], zenoh.Session], shared_endpoint: str
) -> None:
    trials = [make_trial(number) for number in range(1000)]
    for first in range(0, 1000, 250):
        ask("task/reach/rpc/report", {"trials": trials[first : first + 250], "wait": True})
    task = ask("task/reach/rpc/status")["task"]
    greedy = plain(shared_endpoint)
    page = msgpack.packb({"limit": 1000})
    replies = [
        greedy.get(
            f"crkr/@v1/task/{task}/rpc/samples",
            zenoh.handlers.FifoChannel(1),
            payload=page,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=60.0,
        )
        for _ in range(OUTSTANDING)
    ]
    for _ in range(20):
        assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 20
    assert ask("task/reach/rpc/status")["queues"]["samples"]["waiting"] > 0  # so they overtook the pages
    found: Counter[str] = Counter()
    for reply in replies:
        answer = reply.recv()
        if answer.ok is not None:
            found["page"] += 1
        else:
            assert answer.err is not None
            error = msgpack.unpackb(answer.err.payload.to_bytes())
            assert error["retry_ms"] > 0
            found[error["code"]] += 1
    assert set(found) == {"page", "BUSY"}
    assert found["page"] >= 256
