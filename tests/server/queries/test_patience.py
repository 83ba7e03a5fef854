"""Long questions are asked once, dropped when their askers are gone, and hold up no other task and no other client."""

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from crkr.client.network.config import Connection
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.rpc import Rpc
from crkr.protocol import pack, task_key
from crkr.protocol.messages.call_metadata import CallMetadata
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.fair_queue import FairQueue
from crkr.server.queries.queue import Lane
from crkr.server.queries.request import Request
from crkr.server.session import open_session

PATIENCE_S = 30.0


@dataclass(frozen=True, slots=True)
class Asking:
    """Real queries, each as the server's request with the channel of its reply."""

    client: zenoh.Session
    queries: zenoh.Queryable[zenoh.handlers.Handler[zenoh.Query]]

    def __call__(
        self, task: str = "reach", message: Any = None, client: bytes = b"", left_ms: int | None = None
    ) -> tuple[Request, zenoh.handlers.Handler[zenoh.Reply]]:
        replies = self.client.get(
            task_key(task, "predict"),
            zenoh.handlers.FifoChannel(1),
            payload=pack(message or {}),
            attachment=CallMetadata(client, left_ms).to_bytes(),
            timeout=PATIENCE_S,
        )
        request = Request(self.queries.recv(), Latencies())
        request.read_metadata()
        return request, replies


@pytest.fixture
def asking(free_port: int, plain: Callable[[str], zenoh.Session]) -> Iterator[Asking]:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable(task_key("*", "*"), zenoh.handlers.FifoChannel(200), complete=True)
        yield Asking(plain(endpoint), queries)


def code(replies: Any) -> str | None:
    reply = replies.recv()
    return None if reply.err is None else str(msgpack.unpackb(reply.err.payload.to_bytes())["code"])


def done(requests: list[Request]) -> None:
    for request in requests:
        request.reply({"done": True})


def test_a_client_waits_once_for_many_states_and_again_and_again_for_one(free_port: int) -> None:
    endpoint, asked, go_on = f"tcp/127.0.0.1:{free_port}", Counter[int](), threading.Event()

    def answer(query: zenoh.Query) -> None:
        assert query.payload is not None
        states = msgpack.unpackb(query.payload.to_bytes())["states"]["shape"]
        asked[len(states)] += 1
        told = query.attachment
        assert (told is None) == (len(states) == 1)
        if told is not None:
            metadata = CallMetadata.from_bytes(told.to_bytes())
            assert len(metadata.client) == 16
            assert metadata.left_ms is not None
            assert 0 < metadata.left_ms <= 1000 * PATIENCE_S
        if len(states) == 2 or asked[1] > 2:
            threading.Thread(target=later, args=(query, len(states) == 2)).start()

    def later(query: zenoh.Query, wait: bool) -> None:
        if wait:
            go_on.wait(1.7)  # longer than three ordinary attempts together
        with query:
            query.reply(query.key_expr, pack({"answered": True}), encoding="application/msgpack;crkr.predict.v1")

    with open_session(endpoint, None) as session, ZenohTransport(Connection.choose(endpoint, None)) as transport:
        queryable = session.declare_queryable(task_key("reach", "predict"), answer)
        for states in (np.zeros((40, 2)), np.zeros(2)):
            reply = Rpc(transport, PATIENCE_S).call(task_key("reach", "predict"), {"states": states}, PATIENCE_S)
            assert reply == {"answered": True}
        assert queryable is not None
    assert asked[2] == 1
    assert asked[1] == 3


def test_what_its_asker_gave_up_is_not_worked_off(asking: Asking) -> None:
    worked: list[Request] = []

    def work(requests: list[Request]) -> None:
        worked.extend(requests)
        done(requests)

    lane = Lane[Request]("late", {"predict": 10}, work, fair=True, patience_s=1e9)
    late, told = asking(left_ms=0)
    timely, answered = asking(left_ms=60_000)
    silent, answered_too = asking()
    for request in (late, timely, silent):
        assert lane.offer(request) is None
    lane.start()
    assert [code(told), code(answered), code(answered_too)] == ["BUSY", None, None]
    assert worked == [timely, silent]
    lane.close(5.0)


def test_work_in_progress_ends_with_its_askers_patience(asking: Asking) -> None:
    slices: Counter[Request] = Counter()

    def work(requests: list[Request]) -> list[Request]:
        slices.update(requests)
        requests[0].deadline = 0.0
        return requests

    lane = Lane[Request]("endless", {"predict": 10}, work, fair=True, patience_s=1e9)
    request, told = asking(left_ms=60_000)
    assert lane.offer(request) is None
    lane.start()
    assert code(told) == "BUSY"
    assert slices[request] == 1
    assert lane.depths()["predict"]["waiting"] == 0
    lane.close(5.0)


def test_a_repeat_of_a_question_is_answered_with_the_first_and_worked_at_once_only(asking: Asking) -> None:
    worked: list[Request] = []

    def work(requests: list[Request]) -> None:
        worked.extend(requests)
        done(requests)

    lane = Lane[Request]("repeats", {"predict": 10}, work, fair=True, patience_s=1e9, joins=True)
    question = {"states": [[0.1, 0.2]] * 40, "trial_ids": [bytes(16)]}
    asked = [asking(message=question) for _ in range(5)]
    other = asking(message={**question, "trial_ids": [b"x" * 16]})
    elsewhere = asking(task="other", message=question)
    unnamed = [asking(message={"states": [[0.1, 0.2]]}) for _ in range(2)]  # each is given ids of its own
    for request, _ in [*asked, other, elsewhere, *unnamed]:
        assert lane.offer(request) is None
    assert lane.depths()["predict"]["waiting"] == 5
    lane.start()
    for _, replies in [asked[0], *asked[-2:], other, elsewhere, *unnamed]:
        assert code(replies) is None
    for _, replies in asked[1:3]:  # attempts long over
        with pytest.raises(zenoh.ZError):
            replies.recv()
    assert len(worked) == 5
    again, replies = asking(message=question)
    assert lane.offer(again) is None
    assert code(replies) is None
    assert len(worked) == 6
    lane.close(5.0)


def test_earlier_repeats_are_dropped_by_the_thread_that_answers_and_few_wait_for_it(asking: Asking) -> None:
    lane = Lane[Request]("repeats", {"predict": 3}, done, joins=True)
    asked = [asking(message={"states": [[0.1, 0.2]], "trial_ids": [bytes(16)]}) for _ in range(8)]
    taken = [lane.offer(request) is None for request, _ in asked]
    assert taken == [True] * 6 + [False] * 2  # one waits, two are answered with it, and three are to be dropped
    assert not any(request.answered for request, _ in asked)
    lane.start()
    for _, replies in [asked[0], *asked[4:6]]:
        assert code(replies) is None
    for _, replies in asked[1:4]:
        with pytest.raises(zenoh.ZError):
            replies.recv()
    lane.close(5.0)
    for request, _ in asked[6:]:
        request.let_go()


def test_earlier_repeats_are_dropped_as_a_lane_closes(asking: Asking) -> None:
    lane = Lane[Request]("repeats", {"predict": 3}, done, joins=True)
    asked = [asking(message={"states": [[0.1, 0.2]], "trial_ids": [bytes(16)]}) for _ in range(5)]
    assert [lane.offer(request) for request, _ in asked] == [None] * 5
    lane.close(5.0)
    assert all(request.answered for request, _ in asked)


def test_one_client_has_a_part_of_a_lane_only(asking: Asking) -> None:
    lane = Lane[Request]("shared", {"predict": 40}, done, fair=True)
    asked = [asking(client=b"a" * 16) for _ in range(12)]
    refused = [lane.offer(request) is not None for request, _ in asked]
    assert refused == [False] * 10 + [True] * 2
    other = asking(client=b"b" * 16)
    assert lane.offer(other[0]) is None
    lane.start()
    for _, replies in [*asked[:10], other]:
        assert code(replies) is None
    more = [asking(client=b"a" * 16) for _ in range(10)]  # what was answered counts no more
    assert [lane.offer(request) for request, _ in more] == [None] * 10
    lane.close(5.0)
    late, _ = asking(client=b"a" * 16)
    assert lane.offer(late) is not None  # it is closed
    for request in [late, *(refused for refused, _ in asked[-2:])]:
        request.let_go()


def test_tasks_and_clients_take_turns_and_small_questions_overtake_a_giant(asking: Asking) -> None:
    queue = FairQueue[Request]()
    made = {}
    for name, task, client, left in [
        ("giant", "a", b"x" * 16, 1e6),
        ("small", "a", b"x" * 16, 1.0),
        ("other client", "a", b"y" * 16, 1e6),
        ("other task", "b", b"x" * 16, 1e6),
    ]:
        request, _ = asking(task=task, client=client)
        request.left = left
        made[request] = name
        queue.append(request)
    order = []
    for _ in range(12):
        request = queue.popleft()
        order.append(made[request])
        if made[request] != "small":
            queue.put_back(request)
    assert order[1::2] == ["other task"] * 6
    assert Counter(order[::2])["other client"] == 3
    assert order.index("small") <= 6
    assert sorted(made[request] for request in queue.clear()) == ["giant", "other client", "other task"]
    assert len(queue) == 0
    for request in made:
        request.let_go()


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"\xc1", b"\x91" * 300, b"\x91" * 200, msgpack.packb([1, 2]), pack({"client": bytes(400)})),
        *(pack({"client": "text", "left_ms": "soon"}), pack({"left_ms": -1}), pack({"left_ms": 2**62, "client": b"x"})),
    ],
)
def test_an_attachment_of_another_program_says_nothing(data: bytes) -> None:
    assert CallMetadata.from_bytes(data) == CallMetadata()


def test_metadata_is_read_as_it_was_written() -> None:
    told = CallMetadata(b"0123456789abcdef", 1500)
    assert CallMetadata.from_bytes(told.to_bytes()) == told
    assert CallMetadata.from_bytes(pack({"client": told.client, "left_ms": 1500, "later": [1]})) == told


def test_what_would_wait_too_long_for_its_turn_is_refused_and_another_task_is_not(asking: Asking) -> None:
    started, let_go = threading.Event(), threading.Event()

    def work(requests: list[Request]) -> None:
        started.set()
        let_go.wait(PATIENCE_S)
        done(requests)

    lane = Lane[Request]("long", {"predict": 1000}, work, fair=True, longest_s=0.0)
    taken = [lane.offer(asking("reach")[0]) is None for _ in range(20)]
    assert taken == [True] * 8 + [False] * 12
    lane.start()
    assert started.wait(PATIENCE_S)
    assert lane.offer(asking("other")[0]) is None
    let_go.set()
    lane.close(PATIENCE_S)
