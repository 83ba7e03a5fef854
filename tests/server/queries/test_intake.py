"""The intake takes what came before its thread did, and what comes after its session was opened again."""

from collections.abc import Callable
from typing import Any

import msgpack
import pytest
import zenoh
from processes import Processes

from crkr.protocol import ShuttingDown, UnknownTask, task_key
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.intake import Intake
from crkr.server.queries.queue import Lane
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


def check(task: str) -> None:
    if task == "elsewhere":
        raise ShuttingDown("another server serves it")
    if task == "nobody":
        raise UnknownTask("no task of that name")


def ask_again(_: Request) -> bool:
    raise ShuttingDown("too many ask already")


@pytest.mark.parametrize("task", ["elsewhere", "nobody"])
def test_what_is_not_answered_is_dropped_with_the_answers_where_another_thread_may_take_over(
    task: str, free_port: int, plain: Callable[[str], zenoh.Session], processes: Processes
) -> None:
    endpoint, seen = f"tcp/127.0.0.1:{free_port}", list[str]()
    with open_session(endpoint, None) as session:
        intake = Intake(session, task_key("*", "*"), {}, Latencies(), Refuser(), answer, check, ask_again)
        asking, first, last = plain(endpoint), task_key(task, "predict"), task_key("other", "predict")

        def told(name: str) -> Any:  # on the connection's one thread, so in the order in which it was sent
            return zenoh.handlers.Callback(lambda _: None, lambda: seen.append(name), indirect=False)

        asking.get(first, told("dropped"), payload=b"\x80", timeout=10 * PATIENCE_S)
        asking.get(last, told("answered"), payload=b"\x80", timeout=PATIENCE_S)
        behind = session.declare_queryable("behind", lambda query: query.reply("behind", b""))
        assert list(asking.get("behind", timeout=PATIENCE_S))  # all are in the channel, hence taken in one round
        intake.start()
        processes.wait_until(lambda: len(seen) == 2)
        assert seen == ["answered", "dropped"]
        assert behind is not None


def test_one_request_that_cannot_be_handed_over_is_told_so_and_the_others_are_handed_over(
    free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    endpoint, checked = f"tcp/127.0.0.1:{free_port}", list[str]()

    def check_once(task: str) -> None:
        checked.append(task)
        if task == "odd" and checked.count(task) > 1:
            raise MemoryError

    def leave(requests: list[Request]) -> list[Request]:
        for request in requests:
            request.patient = True
        return requests

    def work(requests: list[Request]) -> None:
        answer(requests)

    with open_session(endpoint, None) as session:
        lane = Lane[Request]("bulk", {"predict": 10}, work)
        intake = Intake(session, task_key("*", "*"), {"predict": lane}, Latencies(), Refuser(), leave, check_once)
        asking = plain(endpoint)
        asked = {task: question(asking, task) for task in ("odd", "even", "reach")}
        behind = session.declare_queryable("behind", lambda query: query.reply("behind", b""))
        assert list(asking.get("behind", timeout=PATIENCE_S))
        lane.start()
        intake.start()
        replies = {task: waiting.recv() for task, waiting in asked.items()}
        assert [task for task, reply in replies.items() if reply.ok is None] == ["odd"]
        assert replies["odd"].err is not None
        assert msgpack.unpackb(replies["odd"].err.payload.to_bytes())["code"] == "INTERNAL"
        lane.close(PATIENCE_S)
        assert behind is not None
