"""The intake takes what came before its thread did, and what comes after its session was opened again."""

from collections.abc import Callable

import pytest
import zenoh

from crkr.protocol import task_key
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.intake import Intake
from crkr.server.queries.refusals import Refuser
from crkr.server.queries.request import Request
from crkr.server.session import open_session

PATIENCE_S = 20.0


def answer(requests: list[Request]) -> list[Request]:
    for request in requests:
        request.reply({"state": [0.0]})
    return []


def question(session: zenoh.Session, task: str) -> zenoh.handlers.Handler[zenoh.Reply]:
    return session.get(task_key(task, "predict"), zenoh.handlers.FifoChannel(1), payload=b"\x80", timeout=PATIENCE_S)


def test_queries_that_came_before_the_thread_are_answered(
    free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    endpoint, names = f"tcp/127.0.0.1:{free_port}", [f"task-{number}" for number in range(20)]
    with open_session(endpoint, None) as session:
        made = [Intake(session, task_key(name, "*"), {}, Latencies(), Refuser(), answer) for name in names]
        asking = plain(endpoint)
        waiting = [question(asking, name) for name in names]
        answered_behind = session.declare_queryable("behind", lambda query: query.reply("behind", b""))
        assert list(asking.get("behind", timeout=PATIENCE_S))  # a connection keeps its order: all are in their channels
        for intake in made:
            intake.start()
        assert all(replies.recv().ok is not None for replies in waiting)
        assert answered_behind is not None


def test_an_intake_that_was_moved_answers_in_the_new_session(
    free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as before:
        intake = Intake(before, task_key("*", "*"), {}, Latencies(), Refuser(), answer)
        intake.start()
        assert question(plain(endpoint), "reach").recv().ok is not None
    for _ in range(3):
        with open_session(endpoint, None) as session:
            intake.move(session)
            asking = plain(endpoint)
            for _ in range(3):
                assert question(asking, "reach").recv().ok is not None


@pytest.mark.parametrize("size", [65_533, 60_001])
def test_a_key_as_long_as_a_reply_can_carry_is_refused_in_words(
    size: int, free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        refuser = Refuser()
        intake = Intake(session, task_key("*", "*"), {}, Latencies(), refuser, answer)
        intake.start()
        refuser.start()
        room = size - len(task_key("", "predict"))
        assert question(plain(endpoint), "k" * room).recv().err is not None
        refuser.close(PATIENCE_S)


def test_a_large_attachment_is_refused(free_port: int, plain: Callable[[str], zenoh.Session]) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        refuser = Refuser()
        intake = Intake(session, task_key("*", "*"), {}, Latencies(), refuser, answer)
        intake.start()
        refuser.start()
        asking, taken = plain(endpoint), []
        for size in (2**17, 2**10):
            replies = asking.get(
                task_key("reach", "predict"), zenoh.handlers.FifoChannel(1), attachment=bytes(size), timeout=PATIENCE_S
            )
            taken.append(replies.recv().ok is not None)
        assert taken == [False, True]
        refuser.close(PATIENCE_S)
