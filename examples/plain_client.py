# /// script
# requires-python = ">=3.11"
# dependencies = ["eclipse-zenoh>=1.10", "msgpack>=1.1"]
# ///
"""The whole protocol without the crkr package: for writers of clients in other languages.

    crkr server
    python examples/plain_client.py [tcp/127.0.0.1:7447]

A query is a msgpack map sent to a key; the answer is a map, or an error reply {code, message, retry_ms?, details?}.
Arrays are {"shape", "dtype", "data"} with little-endian bytes, ids are 16 bytes. The same message may be sent again
when no answer came: ids make it harmless.
"""

import json
import struct
import sys
import time
import uuid
from collections.abc import Iterator
from typing import Any

import msgpack
import zenoh

Message = dict[str, Any]
DEADLINE_S = 5.0
SPEC = {
    "name": f"plain-{uuid.uuid4()}",
    "state": [{"name": "distance", "unit": "m", "low": 0.0, "high": 4.0}],
    "goal": [{"name": "speed", "unit": "m/s", "low": 0.0, "high": 8.0}, {"name": "angle", "low": -1.0, "high": 1.0}],
    "novel": "refuse",  # rather an error than a guess far from all samples
}


def connect(endpoint: str) -> zenoh.Session:
    """Connects to one endpoint, without discovery."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 5000,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def ask(session: zenoh.Session, verb: str, message: Message, version: int = 1) -> Message:
    """Repeats a query until it is answered; returns the map, which has "code" if it is an error reply."""
    deadline = time.monotonic() + DEADLINE_S
    encoding = f"application/msgpack;crkr.{verb.rpartition('/')[2]}.v{version}"
    while time.monotonic() < deadline:
        replies = session.get(
            f"crkr/@v1/{verb}",
            payload=msgpack.packb(message),
            encoding=encoding,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=1.0,
        )
        for reply in replies:  # empty while no server answers
            body = payload(reply)
            if body != b"Timeout":  # Zenoh's own error
                answer: Message = msgpack.unpackb(body)
                return answer
        time.sleep(0.1)
    raise TimeoutError(f"no answer from {verb} within {DEADLINE_S} s")


def payload(reply: zenoh.Reply) -> bytes:
    """The bytes of an answer, good or bad."""
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()
    return b"Timeout" if reply.err is None else reply.err.payload.to_bytes()


def array(numbers: list[float]) -> Message:
    """A vector in the protocol's form; the server also accepts plain lists."""
    return {"shape": [len(numbers)], "dtype": "<f8", "data": struct.pack(f"<{len(numbers)}d", *numbers)}


def numbers(value: Message) -> list[float]:
    """All numbers of an array, the last index fastest."""
    kind = {"<f8": "d", "<f4": "f", "<i8": "q"}[value["dtype"]]
    return list(struct.unpack(f"<{len(value['data']) // struct.calcsize(kind)}{kind}", value["data"]))


def trial(state: list[float], goal: list[float], cost: float, kind: str = "trial") -> Message:
    """One trial under a new id."""
    return {
        "id": uuid.uuid4().bytes,
        "state": array(state),
        "goal": array(goal),
        "cost": cost,
        "success": True,
        "kind": kind,
    }


def pages(session: zenoh.Session, task: str) -> Iterator[Message]:
    """Every stored trial, two at a time."""
    position = 0
    while position is not None:
        page = ask(session, f"{task}/rpc/samples", {"after": position, "limit": 2})
        yield from page["samples"]
        position = page["next"]


def flood(session: zenoh.Session, task: str) -> int:
    """Sends more queries at once than the server queues; counts the answers BUSY."""
    question = msgpack.packb({"state": [1.0]})
    waiting = [
        session.get(f"crkr/@v1/{task}/rpc/explain", zenoh.handlers.FifoChannel(1), payload=question, timeout=10.0)
        for _ in range(3000)
    ]
    answers = [payload(reply) for replies in waiting for reply in replies]
    return sum(msgpack.unpackb(answer).get("code") == "BUSY" for answer in answers if answer != b"Timeout")


def converse(session: zenoh.Session) -> None:
    """Creates a task, reports, predicts, explains, pages through the log."""
    task = f"task/{SPEC['name']}"
    info = ask(session, "rpc/info", {})
    print(f"server {info['version']}, protocol {info['protocol']}, limits {info['limits']}")
    print("created:", ask(session, "rpc/create_task", SPEC)["created"])
    print("created again:", ask(session, "rpc/create_task", SPEC)["created"])
    found = ask(session, f"{task}/rpc/spec", {})  # one task; `rpc/tasks` lists all, in pages by `limit` and `after`
    print(f"looked up: budget {found['spec']['budget']}, archived {found['archived']}")
    print("before any sample:", ask(session, f"{task}/rpc/predict", {"states": [1.0]})["code"])

    shown = [trial([d], [2 * d, 0.25], 0.1 * d, "demonstration") for d in (0.5, 1.0, 1.5, 2.0)]
    report = {"trials": shown, "wait": True}  # wait: the next prediction knows them
    print("receipt:", ask(session, f"{task}/rpc/report", report))
    print("the same again:", ask(session, f"{task}/rpc/report", report))

    tried = uuid.uuid4().bytes  # made here, so that asking again draws the same goal
    question = {"states": array([1.2]), "explore": True, "trial_ids": [tried]}
    answer = ask(session, f"{task}/rpc/predict", question)
    print(f"goal {numbers(answer['goals'])}, sigma {numbers(answer['sigmas'])}, novelty {numbers(answer['novelty'])}")
    repeated = numbers(ask(session, f"{task}/rpc/predict", question)["goals"])
    print("asked again:", max(abs(a - b) for a, b in zip(numbers(answer["goals"]), repeated, strict=True)) < 1e-9)
    result = {**trial([1.2], numbers(answer["goals"]), 0.3), "id": tried, "model_version": answer["model_version"]}
    print("stored as number", ask(session, f"{task}/rpc/report", {"trials": [result], "wait": True})["seqs"][0])

    why = ask(session, f"{task}/rpc/explain", {"state": [1.2], "sample_id": tried})
    print(f"active: {why['active']}, neighbours: {[round(n['weight'], 3) for n in why['neighbours']]}")
    print("log:", [(sample["seq"], sample["kind"], sample["cost"]) for sample in pages(session, task)])


def provoke(session: zenoh.Session) -> None:
    """Provokes other answers; only STORAGE, SHUTTING_DOWN and INTERNAL need a server in trouble."""
    task = f"task/{SPEC['name']}"
    stored = next(pages(session, task))
    mistakes: dict[str, tuple[str, Message, int]] = {
        "a goal out of bounds": (f"{task}/rpc/report", {"trials": [trial([1.0], [99.0, 0.0], 0.1)]}, 1),
        "half a message": (f"{task}/rpc/report", {}, 1),
        "no such task": ("task/nobody/rpc/predict", {"states": [1.0]}, 1),
        "another specification": ("rpc/create_task", {**SPEC, "budget": 7}, 1),
        "another trial under a known id": (f"{task}/rpc/report", {"trials": [{**stored, "cost": 0.9}]}, 1),
        "no such verb": (f"{task}/rpc/foretell", {}, 1),
        "another version": (f"{task}/rpc/predict", {"states": [1.0]}, 2),
        "far from all samples": (f"{task}/rpc/predict", {"states": [400.0]}, 1),
    }
    for what, (verb, message, version) in mistakes.items():
        error = ask(session, verb, message, version)
        print(f"{what}: {error['code']} ({error['message']})")
    print("too much at once: BUSY" if flood(session, task) else "too much at once: answered all the same")


if __name__ == "__main__":
    with connect(sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447") as plain_session:
        converse(plain_session)
        provoke(plain_session)
