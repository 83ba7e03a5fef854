"""Questions about one state and their answers, packed without a map: the same bytes in a fraction of the time.

Such messages differ in a few numbers and an id only. The rest is encoded once, and compared when read; a message of any
other form is left to the codec.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple
from uuid import UUID

import msgpack
import numpy as np

from crkr.protocol.codec import Array, pack
from crkr.protocol.messages.predict import Prediction

__all__ = ["Question", "packed_question", "packed_rows", "read_answer", "read_question", "state_bytes"]

_BEFORE: Final = ("goals", "means", "sigmas", "novelty", "success_probability")
_SCALARS: Final = frozenset(_BEFORE[3:])
_AFTER: Final = ("predicted_outcome", "predicted_outcome_sd")


def _entry(name: str, value: object) -> bytes:
    """One entry of a map, without the map."""
    return pack({name: value})[1:]


_ID_HEAD: Final = _entry("trial_ids", [bytes(16)])[:-16]
_THREE: Final = bytes([0x83])  # header of a map with three entries
_LONGEST: Final = 128  # name of a worker


class Question(NamedTuple):
    """A question about one state.

    Attributes:
        state: 8 d bytes, little-endian float64, not checked.
        explore: Draw a goal to try.
        trial_id: 16 bytes.
        worker: Name of the asking worker.
    """

    state: bytes
    explore: bool
    trial_id: bytes
    worker: str | None


def packed_question(state: Array, explore: bool, trial_id: bytes, worker: str | None) -> bytes:
    """Packs the question about one state (d,), as `pack` does with `PredictRequest.to_wire`.

    Args:
        state: Float64, checked.
        explore: Draw a goal to try.
        trial_id: 16 bytes.
        worker: Name of the asking worker.
    """
    head, middle, tail = _question(len(state), explore, worker)
    return b"".join((head, state.tobytes(), middle, trial_id, tail))


@lru_cache(256)
def _question(dimensions: int, explore: bool, worker: str | None) -> tuple[bytes, bytes, bytes]:
    """The bytes before the state, between state and id, and after the id."""
    count = 2 + explore + (worker is not None)
    head = bytes([0x80 + count]) + _array_head("states", 8 * dimensions, False)
    middle = (_entry("explore", True) if explore else b"") + _ID_HEAD
    return head, middle, b"" if worker is None else _entry("worker", worker)


def read_question(data: bytes, dimensions: int) -> Question | None:
    """Reads the question about one state (d,) with d = `dimensions`; None for any other form."""
    found = _question_form(dimensions).fullmatch(data)
    if found is None:
        return None
    count, state, explore, trial_id, worker = found.groups()
    if count[0] != 0x82 + (explore is not None) + (worker is not None):
        return None
    name = None if worker is None else _name(worker)
    return None if name == "" else Question(state, explore is not None, trial_id, name)


@lru_cache(64)
def _question_form(dimensions: int) -> re.Pattern[bytes]:
    """Groups: the map's header, the state, the flag, the id, the worker's name with its own header."""
    width = 8 * dimensions
    states, explore, worker = _array_head("states", width, False), _entry("explore", True), _entry("worker", "")[:-1]
    return re.compile(
        rb"([\x82-\x84])%b(.{%d})(%b)?%b(.{16})(?:%b(.{1,%d}))?"
        % (re.escape(states), width, re.escape(explore), re.escape(_ID_HEAD), re.escape(worker), 4 * _LONGEST + 5),
        re.DOTALL,
    )


@lru_cache(1024)
def _name(data: bytes) -> str:
    """A worker's name; "" where the bytes are not a valid one."""
    try:
        name = msgpack.unpackb(data)
    except (ValueError, TypeError, msgpack.UnpackException):
        return ""
    return name if type(name) is str and len(name) <= _LONGEST else ""


def read_answer(data: bytes, state: Array, outputs: int) -> Prediction | None:
    """Reads the answer about one state (d,) whose goal has p = `outputs` numbers; None for any other form.

    Its arrays are read-only views of one copy of the numbers.
    """
    found = _answer_form(outputs).fullmatch(data)
    if found is None:
        return None
    *parts, trial_id, rest, time_us = found.groups()
    scalars, compute_us = _read_scalars(rest), _count(time_us)
    if scalars is None or compute_us is None:
        return None
    numbers = np.frombuffer(b"".join(parts), "<f8")
    goals, means, sigmas, (novelty, chance) = (
        numbers[:outputs],
        numbers[outputs : 2 * outputs],
        numbers[2 * outputs : 3 * outputs],
        numbers[3 * outputs :].reshape(2, 1),
    )
    return Prediction(
        state, goals, means, sigmas, novelty.reshape(()), [UUID(bytes=trial_id)], *scalars, compute_us=compute_us,
        success_probability=chance.reshape(()),
    )  # fmt: skip


@lru_cache(64)
def _answer_form(outputs: int) -> re.Pattern[bytes]:
    """Groups: the arrays of `_BEFORE`, the id, what all answers of a model share, the model's time."""
    form = rb"\x8a"
    for name in _BEFORE:
        scalar = name in _SCALARS
        width = 8 if scalar else 8 * outputs
        form += rb"%b(.{%d})" % (re.escape(_array_head(name, width, scalar)), width)
    tail = rb"%b(.{16})(.{1,128})%b(.{1,9})" % (re.escape(_ID_HEAD), re.escape(_entry("compute_us", 0)[:-1]))
    return re.compile(form + tail, re.DOTALL)


@lru_cache(64)
def _read_scalars(data: bytes) -> tuple[int, int, str] | None:
    """The entries model_version, active and policy."""
    try:
        rest = msgpack.unpackb(_THREE + data)
        found = rest["model_version"], rest["active"], rest["policy"]
    except (ValueError, TypeError, KeyError, msgpack.UnpackException):
        return None
    if tuple(map(type, found)) != (int, int, str) or len(found[2]) > 32:
        return None
    return found if 0 <= found[0] < 2**62 and 0 <= found[1] < 2**62 else None


@lru_cache(1024)
def _count(data: bytes) -> int | None:
    """A whole number of the protocol."""
    try:
        number = msgpack.unpackb(data)
    except (ValueError, TypeError, msgpack.UnpackException):
        return None
    return number if type(number) is int and 0 <= number < 2**62 else None


def state_bytes(message: Mapping[str, Any], dimensions: int) -> bytes | None:
    """The 8 d bytes of a request's one state; None for a form that needs the full check."""
    states = message.get("states")
    if type(states) is not dict or states.get("dtype") != "<f8" or states.get("shape") != [dimensions]:
        return None
    data = states.get("data")
    return data if type(data) is bytes and len(data) == 8 * dimensions else None


def packed_rows(answer: Prediction, ids: Sequence[bytes], compute_us: int) -> Iterator[bytes]:
    """One reply for each state, as if each had been asked about alone.

    Args:
        answer: For one state (d,) or for many (b, d).
        ids: b ids of 16 bytes.
        compute_us: Time of the model for all of them [us].
    """
    last = _time(compute_us)
    tail = _scalars(answer.model_version, answer.active, answer.policy) + last
    tails = [tail] * len(ids)
    if answer.policy == "corrected" and answer.corrected is not None:  # of some goals only
        uncorrected = _scalars(answer.model_version, answer.active, "mean") + last
        tails = [tail if one else uncorrected for one in np.ravel(answer.corrected).tolist()]
    arrays = [answer.goals, answer.means, answer.sigmas, answer.novelty]
    if answer.success_probability is not None:
        arrays.append(answer.success_probability)
    before = len(arrays)
    if answer.predicted_outcome is not None and answer.predicted_outcome_sd is not None:
        arrays += (answer.predicted_outcome, answer.predicted_outcome_sd)
    data = [array.astype("<f8", copy=False).tobytes() for array in arrays]
    heads = _heads(before, len(data[0]) // len(ids), len(data[-1]) // len(ids) if len(arrays) > before else 0)
    for row, identity in enumerate(ids):
        parts: list[bytes] = []
        for head, every in zip(heads, data, strict=True):
            width = len(every) // len(ids)
            parts += (head, every[row * width : (row + 1) * width])
        parts[2 * before : 2 * before] = (_ID_HEAD, identity, tails[row])
        yield b"".join(parts)


@lru_cache(256)
def _heads(before: int, width: int, measured: int) -> tuple[bytes, ...]:
    """The bytes before each array of an answer.

    Args:
        before: How many of `_BEFORE` it has.
        width: Bytes of a goal.
        measured: Bytes of an expected outcome; 0 without one.
    """
    heads = [_array_head(name, 8 if name in _SCALARS else width, name in _SCALARS) for name in _BEFORE[:before]]
    heads += [_array_head(name, measured, False) for name in _AFTER] if measured else ()
    return bytes([0x80 + len(heads) + 5]) + heads[0], *heads[1:]  # the header of a map this small comes first


@lru_cache(1024)
def _time(compute_us: int) -> bytes:
    return _entry("compute_us", compute_us)


@lru_cache(256)
def _array_head(name: str, width: int, scalar: bool) -> bytes:
    """An array's entry up to its bytes."""
    entry = _entry(name, {"shape": [] if scalar else [width // 8], "dtype": "<f8", "data": bytes(width)})
    return entry[: len(entry) - width]


@lru_cache(256)
def _scalars(model_version: int, active: int, policy: str) -> bytes:
    """The part that all answers of a model share."""
    return pack({"model_version": model_version, "active": active, "policy": policy})[1:]
