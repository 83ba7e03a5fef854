"""What nobody should send is answered by a typed error; the server keeps nothing of it and answers as before."""

import os
import socket
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from processes import RunningServer

from crkr.client import Client

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Rng = np.random.Generator

TASK_VERBS = ("predict", "report", "status", "model", "samples", "explain")
ADMIN_VERBS = ("recost", "remove", "amend", "undo", "refit", "configure", "rollback", "archive")
WRITES = ("report", *ADMIN_VERBS)
AT_ONCE = 64
REFUSALS = {"INVALID", "UNKNOWN_TASK", "UNSUPPORTED", "CONFLICT", "BUSY", "NO_SAMPLES", "NOVEL_STATE"}


def array(shape: Any, dtype: Any = "<f8", data: Any = b"") -> dict[str, Any]:
    return {"shape": shape, "dtype": dtype, "data": data}


def nested(depth: int) -> Any:
    value: Any = 0
    for _ in range(depth):
        value = [value]
    return value


ODD: list[Any] = [
    *(None, True, -1, 0, 1, 2**31, 2**63, 2**64 - 1, -(2**63), 0.5, float("nan"), float("inf"), -0.0, 5e-324, 1e308),
    *("", "x" * 10_000, "\x00", "../../etc", "reach", b"", b"x" * 15, bytes(16), b"x" * 16, [], {}, [[]], [None], [{}]),
    *(
        [0.1, 0.2],
        [[0.1, 0.2]] * 3,
        [[0.1], [0.1, 0.2]],
        [bytes(16)] * 2,
        ["a", 1],
        nested(100),
        {"a": {"b": nested(50)}},
    ),
    *(array([2], data=bytes(16)), array([2], data=bytes(15)), array([-1]), array([0]), array([2**40, 2**40])),
    *(
        array([2], "O", bytes(16)),
        array([2], ">f8", bytes(16)),
        array([2], "<U2", bytes(16)),
        array([2], None, bytes(16)),
    ),
    *(
        array([2], "<f4", bytes(8)),
        array([2], "<i8", b"\xff" * 16),
        array([], data=bytes(8)),
        array([1] * 40, data=bytes(8)),
    ),
    *(
        array("2", data=bytes(16)),
        array([2.0], data=bytes(16)),
        array([True], data=bytes(8)),
        array([2], data="x" * 16),
    ),
    *(msgpack.ExtType(5, b"x"), msgpack.Timestamp(1, 2), {"type": "se-ard", "signal_variance": 0.0}, {"budget": 10**9}),
    *({"kernel": {"signal_variance": 1e300, "linear_weight": 1e300}}, {"regularisation": 5e-324}, {"noise_floor": 0}),
    *({"cost_map": "odds", "learn_from": "all", "budget": 1}, {"novel": "refuse", "novelty_limit": 0.0}),
]
RAW: list[bytes] = [
    b"\xc1",
    b"\x80\x00",
    b"\x91" * 5000,
    b"\x81\xa1a" * 2000,
    b"\x81\xa6states\x91" * 600 + b"\xc0",
    b"\xdf\xff\xff\xff\xff",  # a map of 4 thousand million entries
    b"\xdd\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff",
    b"\xdb\xff\xff\xff\xffx",
    b"\x81\xa6states\xdd\x7f\xff\xff\xff",
    b"\x82\xa6states\x92\xcb" + bytes(8) + b"\xcb" + bytes(8) + b"\xa6states\xc0",  # the same key twice
    b"\x81\x01\x02",
    b"\x81\xc0\x02",
    b"\x81\xa2\xff\xfe\x02",  # a key that is not UTF-8
    b"\x81\xa6worker\xa2\xff\xfe",
    b"\xc7\x00\x7f",
    b"\x80" * 100,
]
ENCODINGS = [None] * 12 + [
    *("application/json", "application/msgpack;crkr.predict.v2", "application/msgpack;crkr.dance.v1", "text/plain"),
    *("application/msgpack", "zenoh/bytes", "application/msgpack;" + "x" * 200, "application/msgpack;crkr.v1", "\x00"),
]
PARAMETERS = [""] * 12 + ["?x=1", "?" + "y" * 1000, "?_time=[now(-1h)..]", "?a=b;c=d|e"]


def valid(verb: str, reach: dict[str, Any], trial: dict[str, Any], rng: Rng) -> dict[str, Any]:
    """A request that a client might send."""
    known = [bytes(15) + bytes([int(rng.integers(1, 30))]) for _ in range(2)]
    asked: dict[str, dict[str, Any]] = {
        "predict": {"states": [0.1, 0.2], "explore": True, "trial_ids": known[:1], "worker": "eve"},
        "report": {"trials": [trial, {**trial, "id": rng.bytes(16)}], "wait": bool(rng.random() < 0.1)},
        "model": {"known_version": 3},
        "samples": {"after": 0, "limit": 5},
        "explain": {"state": [0.1, 0.2], "sample_id": known[0]},
        "create_task": reach,
        "recost": {"ids": known[:1], "costs": [0.5], "reason": "because"},
        "remove": {"ids": [rng.bytes(16)], "reason": "because"},
        "configure": {"changes": {"budget": 20, "kernel": {"signal_variance": 1.0, "linear_weight": 0.0}}},
    }
    return asked.get(verb, {})


def spoil(value: Any, rng: Rng) -> Any:
    """The same with one thing in it replaced, left out or added."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        name = list(value)[rng.integers(len(value))]
        change = rng.random()
        if change < 0.1:
            return {key: entry for key, entry in value.items() if key != name}
        if change < 0.15:
            return {**value, str(ODD[16]): value[name], name + "\udcff".encode("utf-8", "replace").decode(): 1}
        return {**value, name: spoil(value[name], rng)}
    if isinstance(value, list) and value and rng.random() < 0.8:
        place = int(rng.integers(len(value)))
        return [*value[:place], spoil(value[place], rng), *value[place + (rng.random() < 0.7) :]]
    return ODD[rng.integers(len(ODD))]


def scramble(data: bytes, rng: Rng) -> bytes:
    """The same with bytes changed, cut or repeated."""
    spoiled = bytearray(data or b"\x80")
    for _ in range(int(rng.integers(1, 5))):
        spoiled[rng.integers(len(spoiled))] = rng.integers(256)
    cut = int(rng.integers(len(spoiled) + 1))
    return bytes(spoiled[:cut]) if rng.random() < 0.3 else bytes(spoiled) + bytes(spoiled[cut:] if cut % 2 else b"")


def payload(verb: str, reach: dict[str, Any], trial: dict[str, Any], rng: Rng) -> bytes:
    kind = rng.random()
    if kind < 0.1:
        return bytes(rng.bytes(int(rng.integers(0, 400))))
    if kind < 0.2:
        return RAW[rng.integers(len(RAW))]
    message = valid(verb, reach, trial, rng)
    if kind < 0.5:
        return scramble(msgpack.packb(message), rng)
    for _ in range(int(rng.integers(1, 3))):
        message = spoil(message, rng)
    return bytes(msgpack.packb(message))


def key(rng: Rng) -> tuple[str, str]:
    """Where to, and the verb."""
    kind = rng.random()
    if kind < 0.1:
        verb = ("info", "tasks", "create_task", "dance", "*")[rng.integers(5)]
        return f"rpc/{verb}", verb
    task = ("reach",) * 12 + ("nobody", "*", "x" * 200, "Ünïcode", "reach ", "$*x")
    if kind < 0.65:
        verb = (*TASK_VERBS, "dance", "a" * 500)[rng.integers(8)]
        return f"task/{task[rng.integers(len(task))]}/rpc/{verb}", verb
    verb = (*ADMIN_VERBS, "dance")[rng.integers(len(ADMIN_VERBS) + 1)]
    return f"task/{'shut' if verb == 'archive' else task[rng.integers(len(task))]}/admin/{verb}", verb


def resident(pid: int) -> int:
    """Memory of a process [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


@pytest.mark.parametrize(
    "count",
    [3000, pytest.param(100_000, marks=[pytest.mark.campaign, pytest.mark.timeout(600)])],
    ids=["short", "long"],
)
def test_hostile_messages_get_typed_errors_and_leave_no_trace(
    count: int,
    start_server: Callable[..., Any],
    connect: Callable[[str], Ask],
    plain: Callable[[str], zenoh.Session],
    reach: dict[str, Any],
    make_trial: MakeTrial,
) -> None:
    server = start_server()
    ask = connect(server.endpoint)
    for name in ("reach", "calm", "shut"):
        ask("rpc/create_task", {**reach, "name": name})
        ask(f"task/{name}/rpc/report", {"trials": [make_trial(number) for number in range(20)], "wait": True})
    question = {"states": [[0.1, 0.2], [0.9, -0.3]], "explore": True, "trial_ids": [bytes(16), b"y" * 16]}
    calm = {**ask("task/calm/rpc/predict", question), "compute_us": 0}
    session, rng = plain(server.endpoint), np.random.default_rng(count)
    written: dict[str, set[int]] = {"reach": set(), "shut": set()}
    codes: Counter[str] = Counter()
    made = {"reach", "calm", "shut"}

    def attack(messages: int) -> None:
        sent = []
        for number in range(messages):
            where, verb = key(rng)
            trial = make_trial(1000 + number, kind="evaluation" if number % 2 else "trial")
            body = payload(verb, {**reach, "name": "new"} if rng.random() < 0.1 else reach, trial, rng)
            replies = session.get(
                f"crkr/@v1/{where}{PARAMETERS[rng.integers(len(PARAMETERS))]}",
                zenoh.handlers.FifoChannel(4),
                payload=body,
                encoding=ENCODINGS[rng.integers(len(ENCODINGS))],
                attachment=rng.bytes(int(rng.integers(1, 3000))) if rng.random() < 0.1 else None,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=20.0,
            )
            sent.append((where, verb, body, replies))
            if len(sent) == AT_ONCE or number == messages - 1:
                for each in sent:
                    check(*each)
                sent = []

    def check(where: str, verb: str, body: bytes, replies: Any) -> None:
        reply = replies.recv()
        if reply.ok is None:
            error = reply.err.payload.to_bytes()
            assert error != b"Timeout", (where, body)
            code = msgpack.unpackb(error)["code"]
            assert code in REFUSALS, (where, body, msgpack.unpackb(error))
            codes[code] += 1
            return
        codes["ok"] += 1
        answer = msgpack.unpackb(reply.ok.payload.to_bytes())
        if verb == "create_task" and answer["created"]:
            made.add(msgpack.unpackb(body)["name"])
        elif verb in WRITES:
            written[where.split("/")[1]].update(answer["seqs"] if verb == "report" else [answer["seq"]])

    attack(count // 10)
    before = resident(server.process.pid)
    attack(count - count // 10)
    assert resident(server.process.pid) - before < 30e6
    assert set(codes) >= {"ok", "INVALID", "UNKNOWN_TASK", "UNSUPPORTED", "CONFLICT"}
    assert codes["INVALID"] > count / 4
    assert set(ask("rpc/info")["tasks"]) == made
    for name, seqs in written.items():  # what the log holds was well-formed, and acknowledged
        last = ask(f"task/{name}/rpc/status")["seq"]
        assert seqs | set(range(1, 22)) == set(range(1, last + 1))
    assert {**ask("task/calm/rpc/predict", question), "compute_us": 0} == calm
    assert ask("task/reach/admin/configure", {"changes": {"novel": "predict"}})["spec"]["novel"] == "predict"
    assert ask("task/reach/rpc/predict", {"states": [0.1, 0.2]})["active"] > 0
    server.process.kill()
    server.process.wait(timeout=60)
    again = connect(start_server().endpoint)("task/calm/rpc/predict", question)
    assert {**again, "compute_us": 0} == calm


def test_connections_that_do_not_speak_the_protocol_keep_nobody_out(
    server: RunningServer, connect: Callable[[str], Ask], reach: dict[str, Any]
) -> None:
    ask, rng = connect(server.endpoint), np.random.default_rng(0)
    ask("rpc/create_task", reach)
    before = resident(server.process.pid)
    for _ in range(300):
        noise = rng.bytes(int(rng.integers(1, 3000)))
        with socket.create_connection(("127.0.0.1", server.port)) as link, suppress(OSError):
            link.sendall(noise if rng.random() < 0.5 else len(noise).to_bytes(2, "little") + noise)
    with ExitStack() as stack:
        for _ in range(300):  # that say nothing at all
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port)))
        assert ask("rpc/info")["tasks"] == ["reach"]
        with Client(server.endpoint, timeout_s=5) as another:
            assert another.info()["tasks"] == ["reach"]
    assert resident(server.process.pid) - before < 30e6
