"""A grammar of messages that nobody should send: valid ones of every verb, and then one thing in them is another.

Everything is drawn from one generator, so that a seed gives the same messages again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Final, final

import msgpack
import numpy as np
import zenoh
from odd_values import (
    ENCODINGS,
    FLOATS,
    HUGE,
    MIB,
    ODD,
    ODD_KEYS,
    ODD_TASKS,
    ODD_VERBS,
    PARAMETERS,
    RAW,
    WHOLE,
    encoded,
)
from valid_messages import Rng, one, request, specification

__all__ = ["ADMIN_VERBS", "MOVES", "ROOT", "Grammar", "Message"]

ROOT: Final = "crkr/@v1/"
SERVER_VERBS: Final = ("info", "tasks", "create_task")
TASK_VERBS: Final = ("predict", "report", "status", "spec", "model", "samples", "explain")
MOVES: Final = ("rename", "delete")
ADMIN_VERBS: Final = ("recost", "remove", "amend", "undo", "refit", "configure", "rollback", "archive", *MOVES)
SERVED: Final = tuple(zenoh.KeyExpr(ROOT + each) for each in ("rpc/*", "task/*/rpc/*", "task/*/admin/*"))


@final
@dataclass(frozen=True, slots=True)
class Message:
    """One query, and where it goes.

    Attributes:
        key: Without `ROOT`.
        task: The task's name in the key, "" where there is none.
        verb: The last part of the key.
        answers: How many replies there must be: one for each queryable that the key meets.
    """

    key: str
    task: str
    verb: str
    answers: int
    payload: bytes | None
    encoding: str | None = None
    parameters: str = ""
    attachment: bytes | None = None
    consolidation: str = "NONE"
    target: str = "BEST_MATCHING"
    priority: str = "DATA"

    def ask(self, session: zenoh.Session, timeout_s: float) -> Any:
        """Sends the query; its replies come through the handler that is returned."""
        return session.get(
            f"{ROOT}{self.key}{'?' if self.parameters else ''}{self.parameters}",
            zenoh.handlers.FifoChannel(8),
            payload=self.payload,
            encoding=self.encoding,
            attachment=self.attachment,
            consolidation=getattr(zenoh.ConsolidationMode, self.consolidation),
            target=getattr(zenoh.QueryTarget, self.target),
            priority=getattr(zenoh.Priority, self.priority),
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=timeout_s,
        )

    def __str__(self) -> str:
        size = 0 if self.payload is None else len(self.payload)
        return (
            f"{self.key[:90]}?{self.parameters[:30]} {size} B {self.payload and self.payload[:300]!r} {self.encoding}"
        )


@final
class Grammar:
    """Draws messages.

    Args:
        seed: The same seed gives the same messages.
        tasks: Name -> specification of the tasks that are asked.
        expendable: The one of them that may be archived.
        movable: Tasks that may be renamed and deleted, and of which nothing else is asked.
        new: Names that a task to be created may have.
        spared: A task under whose name others publish, but which nobody asks.
    """

    def __init__(
        self,
        seed: int,
        tasks: Mapping[str, dict[str, Any]],
        expendable: str,
        movable: Sequence[str],
        new: Sequence[str],
        spared: str,
    ) -> None:
        self._rng = np.random.default_rng(seed)
        self._tasks, self._expendable, self._movable, self._new = dict(tasks), expendable, movable, new
        self._published = (*tasks, spared, spared, "nobody", "x" * 200)

    def draw(self) -> Message:
        """The next message."""
        rng = self._rng
        key, task, verb = self._key()
        options: dict[str, Any] = {
            "encoding": one(ENCODINGS, rng),
            "parameters": one(PARAMETERS, rng),
            "attachment": self._attachment(),
        }
        if rng.random() < 0.1:
            options["consolidation"] = one(("AUTO", "NONE", "MONOTONIC", "LATEST"), rng)
        if rng.random() < 0.1:
            options["target"] = one(("ALL", "BEST_MATCHING"), rng)
        if rng.random() < 0.05:
            options["priority"] = one(("REAL_TIME", "DATA_HIGH", "BACKGROUND"), rng)
        payload = self._payload(verb, task)
        met = zenoh.KeyExpr.autocanonize(ROOT + key)
        return Message(key, task, verb, sum(met.intersects(one) for one in SERVED), payload, **options)

    def publication(self) -> tuple[str, bytes | None]:
        """A publication's key without `ROOT`, and its payload; None: a deletion."""
        rng = self._rng
        topic = one(("model", "model", "trial", "evaluation", "dance", "a" * 30_000, "x/y/z"), rng)
        task = one(tuple(self._tasks), rng)
        body = None if rng.random() < 0.05 else self._payload("trial" if topic == "trial" else "notice", task)
        return f"task/{one(self._published, rng)}/pub/{topic}", body

    def token(self) -> str:
        """The key of a liveliness token without `ROOT`."""
        rng = self._rng
        task, name = one((*self._published, "*"), rng), one(("eve", "*", "a" * 500, "\x1b[2J", "é"), rng)
        forms = (
            "live/worker/{}",
            "live/left/{}",
            "live/claim/{}/1",
            "live/role/judge/{}",
            "live/{}",
            "live/worker/{}/x",
        )
        return f"task/{task}/" + one(forms, rng).format(name)

    def _key(self) -> tuple[str, str, str]:
        """The key, the task and the verb in it."""
        rng, kind = self._rng, self._rng.random()
        if kind < 0.04:
            return one(ODD_KEYS, rng), "", "predict"
        if kind < 0.14:
            verb = one((*SERVER_VERBS, *SERVER_VERBS, "create_task", one(ODD_VERBS, rng)), rng)
            return f"rpc/{verb}", "", verb
        task = one(ODD_TASKS, rng) if rng.random() < 0.08 else one(tuple(self._tasks), rng)
        if kind < 0.72:
            verb = one((*TASK_VERBS, "predict", "report", "report", one((*ODD_VERBS, *ADMIN_VERBS), rng)), rng)
            return f"task/{task}/rpc/{verb}", task, verb
        verb = one((*ADMIN_VERBS, "recost", "remove", "configure", one((*ODD_VERBS, *TASK_VERBS), rng)), rng)
        task = self._expendable if verb == "archive" else one(self._movable, rng) if verb in MOVES else task
        return f"task/{task}/admin/{verb}", task, verb

    def _attachment(self) -> bytes | None:
        rng, kind = self._rng, self._rng.random()
        if kind < 0.85:
            return None
        if kind < 0.95:  # who asks, and how long they wait
            asks = {"client": rng.bytes(16), "left_ms": int(rng.integers(1, 60_000))}
            return _packed(asks if kind < 0.9 else self._changed(asks), rng)
        return bytes(rng.bytes(int(rng.integers(0, 2000 if kind < 0.999 else MIB))))

    def _payload(self, verb: str, task: str) -> bytes | None:
        rng, kind = self._rng, self._rng.random()
        if kind < 0.01:
            return None
        if kind < 0.03:
            return bytes(rng.bytes(int(rng.integers(0, 400))))
        if kind < 0.07:
            return one(RAW, rng)
        if kind < 0.0703:
            return b"\x81\xa1x\xc6" + (one(HUGE, rng) - 8).to_bytes(4, "big") + bytes(one(HUGE, rng))
        message = request(verb, self._tasks.get(task, specification("new")), self._new, rng)
        if kind < 0.25:
            return _scrambled(msgpack.packb(message), rng)
        if kind < 0.93:
            message = self._changed(message)
        return _packed(message, rng)

    def _changed(self, message: Any) -> Any:
        """The same with one thing in it replaced, taken out, doubled, renamed or added."""
        rng, places = self._rng, list(_places(message))
        if not places:
            return {"junk": self._odd()}
        path = one(places, rng)
        changed = deepcopy(message)
        within = changed
        for step in path[:-1]:
            within = within[step]
        name, change = path[-1], rng.random()
        if change < 0.7:
            within[name] = self._odd(within[name])
        elif change < 0.8:
            del within[name]
        elif isinstance(within, list):
            within.insert(name, within[name])
        elif change < 0.9:
            within[one((name.upper(), name.encode(), 3, None, name + "\x00", name * 2000), rng)] = within.pop(name)
        else:
            within["junk" if rng.random() < 0.9 else 7] = self._odd()
        return changed

    def _odd(self, value: Any = None) -> Any:
        """Something of another kind, or of the same kind and absurd."""
        rng = self._rng
        if isinstance(value, float) and rng.random() < 0.7:
            return one((*FLOATS, value * 1e9, value * 1e-9, -value), rng)
        if type(value) is int and rng.random() < 0.5:
            return one(WHOLE, rng)
        if isinstance(value, dict) and "dtype" in value and rng.random() < 0.7:
            return self._spoilt_array(value)
        return one(one(ODD, rng), rng)

    def _spoilt_array(self, value: dict[str, Any]) -> dict[str, Any]:
        """An array map with one absurd number, or of another size or type."""
        rng = self._rng
        numbers = np.frombuffer(value["data"], value["dtype"]).reshape(value["shape"]).astype(float)
        change = rng.random()
        if change < 0.6 and numbers.size:
            numbers.flat[int(rng.integers(numbers.size))] = one(FLOATS, rng)
        elif change < 0.8:
            numbers = one((numbers[None], numbers[:-1], np.repeat(numbers, 3), numbers[:0], np.zeros((4097, 2))), rng)
        else:
            return encoded(np.nan_to_num(numbers), one(("<f4", "<i8"), rng))
        return encoded(numbers)


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something stands in a message; array maps are looked into too."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, entry in entries:
        if isinstance(value, list) or isinstance(name, str):
            yield (*path, name)
            yield from _places(entry, (*path, name))


def _packed(message: Any, rng: Rng) -> bytes:
    try:
        return bytes(msgpack.packb(message))
    except (ValueError, OverflowError):  # deeper than its packer goes
        return one(RAW, rng)


def _scrambled(data: bytes, rng: Rng) -> bytes:
    """The same with bits turned over, the end cut off, or a part of it again."""
    kind, spoilt = rng.random(), bytearray(data)
    if kind < 0.5:
        for _ in range(int(rng.integers(1, 5))):
            spoilt[int(rng.integers(len(spoilt)))] ^= 1 << int(rng.integers(8))
        return bytes(spoilt)
    cut = int(rng.integers(len(spoilt) + 1))
    return bytes(spoilt[:cut]) if kind < 0.8 else bytes(spoilt + spoilt[cut:])
