"""Messages that are valid but for one thing get one typed answer each, and nothing of them stays behind."""

import os
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from message_grammar import ADMIN_VERBS, MOVES, ROOT, Grammar, Message
from odd_values import HUGE
from processes import Processes
from valid_messages import specification, trial

from crkr.client import Client

Ask = Callable[..., dict[str, Any]]

AT_ONCE = 64
DEADLINE_S = 30.0  # so generous that a busy machine is no failure
FIRST = 30  # trials that each task has before
REFUSALS = {"INVALID", "UNKNOWN_TASK", "UNSUPPORTED", "CONFLICT", "BUSY", "NO_SAMPLES", "NOVEL_STATE"}
WRITES = ("report", *ADMIN_VERBS)
GROWTH = 80e6  # bytes; the payloads of a long run are some 600e6
LONGEST_REFUSAL = 300_000  # bytes; a key of 64 KiB may be named twice
QUESTION = {"states": [[0.1, 0.2], [0.9, -0.3]], "explore": True, "trial_ids": [bytes(16), b"y" * 16]}


def resident(pid: int) -> int:
    """Memory of a process [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def own_threads(pid: int) -> int:
    """How many threads of a process are Python's; those of Zenoh's runtime have names, come and go."""
    name, found = Path(f"/proc/{pid}/comm").read_text(), 0
    for each in Path(f"/proc/{pid}/task").iterdir():
        found += (each / "comm").read_text() == name
    return found


class Conversation:
    """Sends messages, many at once, and keeps the books of what was answered."""

    def __init__(self, session: zenoh.Session, grammar: Grammar) -> None:
        self._session, self._grammar = session, grammar
        self.codes: Counter[str] = Counter()
        self.created: set[str] = set()
        self.moved: dict[str, str | None] = {}
        self.written: dict[str, set[int]] = {}
        self.wrong: list[str] = []

    def run(self, count: int) -> None:
        """That many messages, with a publication and a token after every hundred."""
        waiting: deque[tuple[Message, Any]] = deque()
        for number in range(count):
            message = self._grammar.draw()
            try:
                waiting.append((message, message.ask(self._session, DEADLINE_S)))
            except zenoh.ZError:  # the sender's own Zenoh refuses such a key
                self.codes["not sent"] += 1
            if number % 100 == 0:
                self._publish()
            if len(waiting) == AT_ONCE:
                self._settle(*waiting.popleft())
        for each in waiting:
            self._settle(*each)

    def _publish(self) -> None:
        try:
            key, body = self._grammar.publication()
            if body is None:
                self._session.delete(ROOT + key)
            else:
                self._session.put(ROOT + key, body)
            self._session.liveliness().declare_token(ROOT + self._grammar.token()).undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the type
        except zenoh.ZError:
            self.codes["not published"] += 1

    def _settle(self, message: Message, replies: Any) -> None:
        found = list(drained(replies))
        if len(found) != message.answers:
            self.wrong.append(f"{len(found)} answers instead of {message.answers}: {message}")
        for reply in found:
            if reply.ok is None:
                self._refused(message, reply.err.payload.to_bytes())
            else:
                self.codes["ok"] += 1
                self._done(message, msgpack.unpackb(reply.ok.payload.to_bytes(), strict_map_key=False))

    def _refused(self, message: Message, error: bytes) -> None:
        code = "Timeout" if error == b"Timeout" else msgpack.unpackb(error)["code"]
        self.codes[code] += 1
        if code not in REFUSALS or len(error) > LONGEST_REFUSAL:
            self.wrong.append(f"{code}, {len(error)} bytes {error[:200]!r}: {message}")

    def _done(self, message: Message, answer: dict[str, Any]) -> None:
        if message.verb == "create_task" and answer["created"]:
            assert message.payload is not None
            self.created.add(msgpack.unpackb(message.payload, strict_map_key=False)["name"])
        elif message.verb in MOVES and "/admin/" in message.key:
            known = self.moved.setdefault(message.task, answer.get("name"))
            assert known == answer.get("name"), f"moved twice: {message}"
        elif message.verb in WRITES and "seq" in str(answer.keys()):
            seqs = answer["seqs"] if message.verb == "report" else [answer["seq"]]
            self.written.setdefault(message.task, set()).update(seqs)


def drained(replies: Any) -> Iterator[Any]:
    """All replies to a query; it is over when their channel closes."""
    while True:
        try:
            yield replies.recv()
        except zenoh.ZError:
            return


@pytest.mark.parametrize(
    "count",
    [5000, pytest.param(200_000, marks=[pytest.mark.campaign, pytest.mark.timeout(3600)])],
    ids=["short", "long"],
)
def test_a_message_with_one_thing_wrong_gets_one_typed_answer_and_leaves_nothing_behind(
    count: int,
    start_server: Callable[..., Any],
    connect: Callable[[str], Ask],
    plain: Callable[[str], zenoh.Session],
    processes: Processes,
) -> None:
    server = start_server()
    ask = connect(server.endpoint)
    names = ("reach", "guided", "shut", "calm")
    tasks = {name: specification(name, guided=name == "guided") for name in names}
    movable = [f"movable-{number}" for number in range(30)]
    asked = {name: spec for name, spec in tasks.items() if name != "calm"}
    rng = np.random.default_rng(count)
    grammar = Grammar(count, asked, "shut", movable, ["new", "reach"], "calm")
    for name in movable:
        ask("rpc/create_task", specification(name))
    for name, spec in tasks.items():
        trials = [{**trial(spec, number + 1, rng), "success": True, "kind": "trial"} for number in range(FIRST)]
        ask("rpc/create_task", spec)
        ask(f"task/{name}/rpc/report", {"trials": trials, "wait": True})
    calm = {**ask("task/calm/rpc/predict", QUESTION), "compute_us": 0}
    for size in HUGE:
        assert "error" in ask("task/reach/rpc/report", payload=b"\x81\xa1x\xc6" + size.to_bytes(4, "big") + bytes(size))
    talk = Conversation(plain(server.endpoint), grammar)
    pid = server.process.pid

    with Client(server.endpoint) as client, client.task("calm").mirror() as mirror:
        talk.run(count // 10)
        threads, memory = own_threads(pid), resident(pid)
        talk.run(count - count // 10)
        assert talk.wrong == []
        assert set(talk.codes) >= {"ok", "INVALID", "UNKNOWN_TASK", "UNSUPPORTED"}
        assert talk.codes["ok"] > count / 20
        assert talk.codes["INVALID"] > count / 4
        processes.wait_until(lambda: own_threads(pid) >= threads, server.log)
        assert resident(pid) - memory < GROWTH

        assert {name is None for name in talk.moved.values()} == {True, False}
        there = {*tasks, *talk.created, *movable, *talk.moved.values()} - {*talk.moved, None}
        assert set(ask("rpc/info")["tasks"]) == there
        for name, seqs in talk.written.items():  # what the log holds was well-formed, and acknowledged
            last = ask(f"task/{name}/rpc/status")["seq"]
            assert seqs | set(range(1, FIRST + 2)) == set(range(1, last + 1))
        assert {**ask("task/calm/rpc/predict", QUESTION), "compute_us": 0} == calm
        assert all("fault" not in ask(f"task/{name}/rpc/status") for name in tasks)

        server.process.kill()
        server.process.wait(timeout=5)
        again = start_server(port=server.port)
        ask = connect(again.endpoint)
        assert set(ask("rpc/info")["tasks"]) == there
        assert {**ask("task/calm/rpc/predict", QUESTION), "compute_us": 0} == calm
        assert all("fault" not in ask(f"task/{name}/rpc/status") for name in tasks)

        # One who has looked on all the time goes on as if nothing had been.
        task = client.task("calm")
        receipt = task.report(state=[0.5, 0.5], goal=rng.uniform(-1, 1, 3), cost=0.0, success=True)
        mirror.wait_for(receipt.seqs[0], DEADLINE_S)
        assert mirror.predict([0.5, 0.5]).goal == pytest.approx(task.predict([0.5, 0.5]).goal, abs=1e-9)
