"""Refusals are paced, and yet nobody waits for one longer than an attempt."""

from collections.abc import Callable

import msgpack
import pytest
import zenoh

from crkr.protocol import CrkrError, task_key
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.intake import Intake
from crkr.server.queries.queue import busy
from crkr.server.queries.refusals import Refuser
from crkr.server.queries.request import Request
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
            refuser.add(Request(queries.recv(), Latencies()).fail, busy("explain"))
        told = pauses = 0
        while told < count:
            batch = refuser.take()
            for tell, error in batch:
                tell(error)
            told, pauses = told + len(batch), pauses + 1
        assert pauses * PAUSE_S < 0.75 * FIRST_ATTEMPT_S
        assert len(batch) <= told / pauses + 1  # evenly, not all at the end
        assert all(replies.recv().err is not None for replies in waiting)


def test_telling_what_was_asked_wrongly_does_not_hold_up_predictions(
    free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"

    def predict(requests: list[Request]) -> list[Request]:
        for request in requests:
            request.reply({"active": 1})
        return []

    with open_session(endpoint, None) as session:
        refuser = Refuser()
        intake = Intake(session, task_key("*", "*"), {}, Latencies(), refuser, predict)
        intake.start()
        asking = plain(endpoint)
        wrong = [task_key("reach", "dance"), task_key("reach", "*"), "crkr/@v1/task/**"]
        replies = [asking.get(key, zenoh.handlers.FifoChannel(1), timeout=60.0) for key in wrong]
        for _ in range(3):  # while nobody tells those
            answer = asking.get(task_key("reach", "predict"), zenoh.handlers.FifoChannel(1), timeout=10.0).recv()
            assert answer.ok is not None
        assert [reply.try_recv() for reply in replies] == [None] * 3
        refuser.start()
        codes = []
        for reply in replies:
            told = reply.recv()
            assert told.err is not None
            codes.append(msgpack.unpackb(told.err.payload.to_bytes())["code"])
        assert codes == ["UNSUPPORTED", "UNSUPPORTED", "INVALID"]
        refuser.close(1.0)


def test_adding_more_refusals_than_can_be_sent_is_slowed() -> None:
    told: list[CrkrError] = []
    refuser = Refuser()
    refuser.start()
    error, most = busy("explain"), 0
    for _ in range(12_000):
        refuser.add(told.append, error)
        most = max(most, len(refuser))
    assert 4096 <= most < 6000
    refuser.close(10.0)
    assert len(told) == 12_000
