"""A grammar of messages that nobody should send: valid ones of every verb, and then one thing in them is another.

Everything is drawn from one generator, so that a seed gives the same messages again. Nothing here knows the server's
code: what a valid message looks like is written down from the protocol's description.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Final, TypeVar, final

import msgpack
import numpy as np
import zenoh

__all__ = [
    "ADMIN_VERBS",
    "ROOT",
    "SERVED",
    "SERVER_VERBS",
    "TASK_VERBS",
    "Grammar",
    "Message",
    "encoded",
    "specification",
]

ROOT: Final = "crkr/@v1/"
SERVER_VERBS: Final = ("info", "tasks", "create_task")
TASK_VERBS: Final = ("predict", "report", "status", "model", "samples", "explain")
ADMIN_VERBS: Final = ("recost", "remove", "refit", "configure", "archive")
SERVED: Final = tuple(zenoh.KeyExpr(ROOT + each) for each in ("rpc/*", "task/*/rpc/*", "task/*/admin/*"))
MIB: Final = 2**20
Rng = np.random.Generator
_Value = TypeVar("_Value")

FLOATS: Final = (float("nan"), float("inf"), float("-inf"), -0.0, 5e-324, -5e-324, 1e-308, 1e308, -1.7e308, 1e154)
WHOLE: Final = (-1, 0, 1, 2, 255, 2**31, 2**32, 2**53 + 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1, -(2**63))
TEXTS: Final = ("", "a", "\x00", "\x1b[2J\x07", "../../etc", "*", "ünïcödé", "\u202ereversed", "x" * 63, "x" * 70_000)
BYTES: Final = (b"", b"\xff", bytes(15), bytes(16), b"x" * 17, b"\x80" * 70_000)


def nested(depth: int, value: Any = 0, *, maps: bool = False) -> Any:
    """A value within so many lists, or maps."""
    for _ in range(depth):
        value = {"a": value} if maps else [value]
    return value


def array(shape: Any, dtype: Any = "<f8", data: Any = b"") -> dict[str, Any]:
    """An array as it stands in a message, right or wrong."""
    return {"shape": shape, "dtype": dtype, "data": data}


def encoded(values: Any, dtype: str = "<f8") -> dict[str, Any]:
    """An array map of these values."""
    numbers = np.asarray(values, dtype)
    return array(list(numbers.shape), dtype, numbers.tobytes())


ARRAYS: Final[tuple[Any, ...]] = (
    *(array([2], data=bytes(15)), array([-1]), array([0]), array([2**40, 2**40]), array([2**63]), array([2, 0])),
    *(array([2], "O", bytes(16)), array([2], ">f8", bytes(16)), array([2], "<U2", bytes(16)), array([2], None)),
    *(array([2], "<f4", bytes(8)), array([2], "<i8", b"\xff" * 16), array([], data=bytes(8)), array([1] * 40)),
    *(
        array("2", data=bytes(16)),
        array([2.0], data=bytes(16)),
        array([True], data=bytes(8)),
        array([2], data="x" * 16),
    ),
    *({"shape": [2]}, {"dtype": "<f8"}, {"data": bytes(16)}, [[0.1], [0.1, 0.2]], [[[0.1]]], [None, 0.1], ["0.1", 0.2]),
    *([0.1] * 5000, [[0.1, 0.2]] * 5000, [bytes(16)] * 2000),
)
SHAPELESS: Final[tuple[Any, ...]] = (
    *(None, True, False, [], {}, [[]], [None], [{}], {"": 0}),
    *(nested(60), nested(400), nested(950), nested(1020), nested(60, maps=True), nested(505, maps=True)),
    *([0] * 20_000, {str(number): number for number in range(5000)}, [{}] * 20_000),
    *({1: 2}, {b"a": 1}, {None: 1}, {1.5: 1}, {True: 1}, {(1, 2): 3}, {"a": {2: {b"b": []}}}),
    *(msgpack.ExtType(5, b"x"), msgpack.ExtType(127, b""), msgpack.Timestamp(1, 2), msgpack.Timestamp(2**40, 0)),
)
ODD: Final[tuple[Sequence[Any], ...]] = (FLOATS, WHOLE, TEXTS, BYTES, ARRAYS, SHAPELESS)
RAW: Final = (
    *(b"\xc1", b"\x80\x00", b"\x91" * 5000, b"\x81\xa1a" * 2000, b"\x81\xa6states\x91" * 600 + b"\xc0"),
    *(b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xffx"),
    *(b"\x81\xa6states\xdd\x7f\xff\xff\xff", b"\x81\x01\x02", b"\x81\xc0\x02", b"\x81\xa2\xff\xfe\x02"),
    *(b"\x81\xa6worker\xa2\xff\xfe", b"\xc7\x00\x7f", b"\x80" * 100, b"", b"\x90", b"\xa1a", b"\x81\xd9\x01a\xc0"),
    b"\x82\xa6states\x92\xcb" + bytes(8) + b"\xcb" + bytes(8) + b"\xa6states\xc0",  # the same key twice
    b"\x81\xa4junk\xdd\x00\x01\x00\x00" + b"\x80" * 2**16,  # maps without end
)
HUGE: Final = (8 * MIB, 8 * MIB + 1, 9 * MIB)
# No longer one can be sent: Zenoh's length of an encoding is a byte.
ENCODINGS: Final = (None,) * 80 + (
    *("application/msgpack", "zenoh/bytes", "", "application/msgpack;crkr.predict.v1", "application/msgpack;crkr.x.v1"),
    *(
        "application/msgpack;crkr.predict.v2",
        "application/msgpack;crkr.predict.v1;more",
        "application/json",
        "\x00\x1b[",
    ),
    *("application/msgpack;crkr.predict.v" + "9" * 200, "application/msgpack;crkr.predict.v1\n", "ünï/cödé"),
    *("text/plain;charset=utf-8", "x" * 255, "application/msgpack;crkr." + "a" * 200 + ".v1"),
)
PARAMETERS: Final = ("",) * 40 + (
    *(
        "x=1",
        "y" * 1000,
        "_time=[now(-1h)..]",
        "_time=nonsense",
        "a=b;c=d|e",
        "_anyke",
        ";;;",
        "=",
        "x=" + "z" * 65_536,
    ),
    "x=\x1b[2J",
)
ODD_TASKS: Final = (
    "nobody",
    "*",
    "$*",
    "re$*",
    "x" * 200,
    "x" * 20_000,
    "Ünïcode",
    "reach ",
    "..",
    "@v1",
    "a\x00b",
    "~",
)
ODD_VERBS: Final = ("dance", "*", "$*", "a" * 500, "a" * 30_000, "PREDICT", "predict ", "präd", "@predict", "\x1b[2J")
ODD_KEYS: Final = (
    *("**", "rpc/**", "task/**", "task/reach/**", "task/reach/*/predict", "*/reach/rpc/predict", "task/*/*/*", "rpc"),
    *(
        "task/reach/rpc/predict/more",
        "task/reach/rpc",
        "live/server/x",
        "live/**",
        "task/reach/pub/model",
        "rpc/info/x",
    ),
    *("x" * 65_000, "task/" + "x" * 65_000 + "/rpc/predict", "task/" + "/".join("abcdefgh" * 20) + "/rpc/predict"),
)


def specification(name: str, *, guided: bool = False) -> dict[str, Any]:
    """A task with every field spelt out: two numbers of state, three of goal."""
    spec: dict[str, Any] = {
        "name": name,
        "description": "for messages",
        "seed": 7,
        "state": [
            {"name": "x", "unit": "m", "low": 0.0, "high": 1.0, "lengthscale": 0.2},
            {"name": "y", "unit": "m", "low": -1.0, "high": 1.0, "lengthscale": 0.4},
        ],
        "goal": [{"name": f"g{one}", "unit": "rad", "low": -2.0, "high": 2.0, "scale": 1.0} for one in range(3)],
        "kernel": {"type": "se-ard", "signal_variance": 1.0, "linear_weight": 0.0},
        "budget": 20,
        "regularisation": 1.0,
        "cost_map": "linear",
        "noise_floor": 1e-4,
        "learn_from": "successes",
        "prior_mean": "demonstrations",
        "explore_scale": 1.0,
        "exploration_floor": 0.0,
        "novel": "predict",
        "novelty_limit": 0.9,
        "selector": "anms",
        "refit_every": 0,
        "exploration": {"type": "gaussian"},
    }
    if guided:
        spec["outcome"] = [
            {"name": name, "unit": "m", "target": 0.0, "tolerance": 0.05, "group": "landing"} for name in ("dx", "dy")
        ]
        given = {"trust": 4.0, "temperature": [0.1, 0.5], "neighbours": 20, "iterations": 2, "min_trials": 10}
        spec["exploration"] = {"type": "outcome", **given, "gate": 2.0}
    return spec


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
        new: Names that a task to be created may have.
        spared: A task under whose name others publish, but which nobody asks.
    """

    def __init__(
        self, seed: int, tasks: Mapping[str, dict[str, Any]], expendable: str, new: Sequence[str], spared: str
    ) -> None:
        self._rng = np.random.default_rng(seed)
        self._tasks, self._expendable, self._new = dict(tasks), expendable, new
        self._published = (*tasks, spared, spared, "nobody", "x" * 200)

    def draw(self) -> Message:
        """The next message."""
        rng = self._rng
        key, task, verb = self._key()
        options: dict[str, Any] = {
            "encoding": _one(ENCODINGS, rng),
            "parameters": _one(PARAMETERS, rng),
            "attachment": self._attachment(),
        }
        if rng.random() < 0.1:
            options["consolidation"] = _one(("AUTO", "NONE", "MONOTONIC", "LATEST"), rng)
        if rng.random() < 0.1:
            options["target"] = _one(("ALL", "BEST_MATCHING"), rng)
        if rng.random() < 0.05:
            options["priority"] = _one(("REAL_TIME", "DATA_HIGH", "BACKGROUND"), rng)
        payload = self._payload(verb, task)
        met = zenoh.KeyExpr.autocanonize(ROOT + key)
        return Message(key, task, verb, sum(met.intersects(one) for one in SERVED), payload, **options)

    def publication(self) -> tuple[str, bytes | None]:
        """A publication's key without `ROOT`, and its payload; None: a deletion."""
        rng = self._rng
        topic = _one(("model", "model", "trial", "evaluation", "dance", "a" * 30_000, "x/y/z"), rng)
        task = _one(tuple(self._tasks), rng)
        body = None if rng.random() < 0.05 else self._payload("trial" if topic == "trial" else "notice", task)
        return f"task/{_one(self._published, rng)}/pub/{topic}", body

    def token(self) -> str:
        """The key of a liveliness token without `ROOT`."""
        rng = self._rng
        task, name = _one((*self._published, "*"), rng), _one(("eve", "*", "a" * 500, "\x1b[2J", "é"), rng)
        forms = (
            "live/worker/{}",
            "live/left/{}",
            "live/claim/{}/1",
            "live/role/judge/{}",
            "live/{}",
            "live/worker/{}/x",
        )
        return f"task/{task}/" + _one(forms, rng).format(name)

    def trial(self, spec: Mapping[str, Any], number: int) -> dict[str, Any]:
        """A trial that is in order, whose id is a number."""
        rng = self._rng
        trial: dict[str, Any] = {
            "id": number.to_bytes(16, "big"),
            "state": _inside(spec, "state", rng),
            "goal": _inside(spec, "goal", rng),
            "cost": float(rng.uniform(0, 0.9)),
            "success": bool(rng.random() < 0.7),
            "kind": _one(("trial", "trial", "demonstration", "evaluation"), rng),
            "worker": "eve",
            "model_version": 3,
            "info": {"epoch": 1, "reason": "none", "path": [1.0, 2.0]},
        }
        if spec.get("outcome"):
            trial["outcome"] = encoded(rng.normal(size=len(spec["outcome"])))
        return trial

    def _key(self) -> tuple[str, str, str]:
        """The key, the task and the verb in it."""
        rng, kind = self._rng, self._rng.random()
        if kind < 0.04:
            return _one(ODD_KEYS, rng), "", "predict"
        if kind < 0.14:
            verb = _one((*SERVER_VERBS, *SERVER_VERBS, "create_task", _one(ODD_VERBS, rng)), rng)
            return f"rpc/{verb}", "", verb
        task = _one(ODD_TASKS, rng) if rng.random() < 0.08 else _one(tuple(self._tasks), rng)
        if kind < 0.72:
            verb = _one((*TASK_VERBS, "predict", "report", "report", _one((*ODD_VERBS, *ADMIN_VERBS), rng)), rng)
            return f"task/{task}/rpc/{verb}", task, verb
        verb = _one((*ADMIN_VERBS, "recost", "remove", "configure", _one((*ODD_VERBS, *TASK_VERBS), rng)), rng)
        task = self._expendable if verb == "archive" else task
        return f"task/{task}/admin/{verb}", task, verb

    def _attachment(self) -> bytes | None:
        kind = self._rng.random()
        if kind < 0.92:
            return None
        return bytes(self._rng.bytes(int(self._rng.integers(0, 2000 if kind < 0.999 else MIB))))

    def _payload(self, verb: str, task: str) -> bytes | None:
        rng, kind = self._rng, self._rng.random()
        if kind < 0.01:
            return None
        if kind < 0.03:
            return bytes(rng.bytes(int(rng.integers(0, 400))))
        if kind < 0.07:
            return _one(RAW, rng)
        if kind < 0.0703:
            return b"\x81\xa1x\xc6" + (_one(HUGE, rng) - 8).to_bytes(4, "big") + bytes(_one(HUGE, rng))
        message = self._valid(verb, self._tasks.get(task, specification("new")))
        if kind < 0.25:
            return _scrambled(msgpack.packb(message), rng)
        if kind < 0.93:
            message = self._changed(message)
        try:
            return bytes(msgpack.packb(message))
        except (ValueError, OverflowError):  # deeper than its packer goes
            return _one(RAW, rng)

    def _changed(self, message: Any) -> Any:
        """The same with one thing in it replaced, taken out, doubled, renamed or added."""
        rng, places = self._rng, list(_places(message))
        if not places:
            return {"junk": self._odd()}
        path = _one(places, rng)
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
            within[_one((name.upper(), name.encode(), 3, None, name + "\x00", name * 2000), rng)] = within.pop(name)
        else:
            within["junk" if rng.random() < 0.9 else 7] = self._odd()
        return changed

    def _odd(self, value: Any = None) -> Any:
        """Something of another kind, or of the same kind and absurd."""
        rng = self._rng
        if isinstance(value, float) and rng.random() < 0.7:
            return _one((*FLOATS, value * 1e9, value * 1e-9, -value), rng)
        if type(value) is int and rng.random() < 0.5:
            return _one(WHOLE, rng)
        if isinstance(value, dict) and "dtype" in value and rng.random() < 0.7:
            return self._spoilt_array(value)
        return _one(_one(ODD, rng), rng)

    def _spoilt_array(self, value: dict[str, Any]) -> dict[str, Any]:
        """An array map with one absurd number, or of another size or type."""
        rng = self._rng
        numbers = np.frombuffer(value["data"], value["dtype"]).reshape(value["shape"]).astype(float)
        change = rng.random()
        if change < 0.6 and numbers.size:
            numbers.flat[int(rng.integers(numbers.size))] = _one(FLOATS, rng)
        elif change < 0.8:
            numbers = _one((numbers[None], numbers[:-1], np.repeat(numbers, 3), numbers[:0], np.zeros((4097, 2))), rng)
        else:
            return encoded(np.nan_to_num(numbers), _one(("<f4", "<i8"), rng))
        return encoded(numbers)

    def _valid(self, verb: str, spec: Mapping[str, Any]) -> dict[str, Any]:
        """A request that a client might send."""
        rng = self._rng
        fresh = 2**40 + int(rng.integers(2**40))
        known = [int(one).to_bytes(16, "big") for one in rng.choice(30, 2, replace=False) + 1]
        states = _inside(spec, "state", rng)
        makers: dict[str, Callable[[], dict[str, Any]]] = {
            "predict": lambda: {"states": states, "explore": True, "trial_ids": known[:1], "worker": "eve"},
            "report": lambda: {
                "trials": [self.trial(spec, fresh), self.trial(spec, fresh + 1)],
                "wait": bool(rng.random() < 0.3),
            },
            "trial": lambda: self.trial(spec, fresh),
            "notice": lambda: {"version": 5, "active": 3, "added": known, "evicted": []},
            "model": lambda: {"known_version": 3},
            "tasks": lambda: {"after": "calm", "limit": 3},
            "samples": lambda: {"after": 0, "limit": 5},
            "explain": lambda: {"state": states, "sample_id": known[0]},
            "create_task": lambda: specification(_one(self._new, rng), guided=bool(rng.random() < 0.3)),
            "recost": lambda: {"ids": known, "costs": encoded([0.5, 0.25]), "reason": "because"},
            "remove": lambda: {"ids": known[:1], "reason": "because"},
            "configure": lambda: {
                "changes": {
                    name: spec.get(name, 1.0)
                    for name in ("budget", "kernel", "regularisation", "noise_floor", "novelty_limit", "refit_every")
                }
            },
        }
        return makers[verb]() if verb in makers else {}


def _one(values: Sequence[_Value], rng: Rng) -> _Value:
    return values[int(rng.integers(len(values)))]


def _inside(spec: Mapping[str, Any], name: str, rng: Rng) -> dict[str, Any]:
    """A point of the box, as well as an odd specification has one."""
    low, high = ([axis.get(end, 0.0) for axis in spec[name]] for end in ("low", "high"))
    part = rng.uniform(size=len(low))
    return encoded(np.asarray(low) * (1 - part) + np.asarray(high) * part)


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something stands in a message; array maps are looked into too."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, entry in entries:
        if isinstance(value, list) or isinstance(name, str):
            yield (*path, name)
            yield from _places(entry, (*path, name))


def _scrambled(data: bytes, rng: Rng) -> bytes:
    """The same with bits turned over, the end cut off, or a part of it again."""
    kind, spoilt = rng.random(), bytearray(data)
    if kind < 0.5:
        for _ in range(int(rng.integers(1, 5))):
            spoilt[int(rng.integers(len(spoilt)))] ^= 1 << int(rng.integers(8))
        return bytes(spoilt)
    cut = int(rng.integers(len(spoilt) + 1))
    return bytes(spoilt[:cut]) if kind < 0.8 else bytes(spoilt + spoilt[cut:])
