"""Questions about one state and their answers as bytes, several times quicker than by a map, and the same bytes.

Such messages differ from one another in a few numbers and an id. All between is encoded once, and compared when read;
a message of any other form is left to the codec.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final
from uuid import UUID

import msgpack
import numpy as np

from crkr.protocol.codec import Array, pack
from crkr.protocol.predict import Prediction

__all__ = ["packed_question", "packed_rows", "read_answer", "state_bytes"]

_BEFORE: Final = ("goals", "means", "sigmas", "novelty")
_AFTER: Final = ("predicted_outcome", "predicted_outcome_sd")


def _entry(name: str, value: object) -> bytes:
    """One entry of a map, without the map."""
    return pack({name: value})[1:]


_ID_HEAD: Final = _entry("trial_ids", [bytes(16)])[:-16]
_NINE, _FOUR = bytes([0x89]), bytes([0x84])  # headers of maps with so many entries


def packed_question(state: Array, explore: bool, trial_id: bytes, worker: str | None) -> bytes:
    """The question about one state (d,), as `pack` writes `PredictRequest.to_wire`.

    Args:
        state: Float64, checked.
        explore: Draw a goal to try.
        trial_id: 16 bytes.
        worker: Who asks.
    """
    head, middle, tail = _question(len(state), explore, worker)
    return b"".join((head, state.tobytes(), middle, trial_id, tail))


@lru_cache(256)
def _question(dimensions: int, explore: bool, worker: str | None) -> tuple[bytes, bytes, bytes]:
    """What stands before the state, between it and the id, and after that."""
    count = 2 + explore + (worker is not None)
    head = bytes([0x80 + count]) + _array_head("states", 8 * dimensions, False)
    middle = (_entry("explore", True) if explore else b"") + _ID_HEAD
    return head, middle, b"" if worker is None else _entry("worker", worker)


def read_answer(data: bytes, state: Array, outputs: int) -> Prediction | None:
    """The answer about one state (d,) whose goal has p = `outputs` numbers, or None where its form is another.

    Its arrays are read-only views of one copy of the numbers.
    """
    fixed, runs, after = _answer(outputs)
    if data[:1] != _NINE:
        return None
    for start, head in fixed:
        if not data.startswith(head, start):
            return None
    rest = _rest(data[after:])
    if rest is None:
        return None
    numbers = np.frombuffer(b"".join([data[start:end] for start, end in runs]), "<f8")
    goals, means, sigmas, novelty = (
        numbers[:outputs],
        numbers[outputs : 2 * outputs],
        numbers[2 * outputs : 3 * outputs],
        numbers[3 * outputs :].reshape(()),
    )
    ids = [UUID(bytes=data[after - 16 : after])]
    return Prediction(state, goals, means, sigmas, novelty, ids, *rest[:3], compute_us=rest[3])


def _rest(data: bytes) -> tuple[int, int, str, int] | None:
    """The entries behind the id: model_version, active, policy, compute_us."""
    try:
        rest = msgpack.unpackb(_FOUR + data)
        found = rest["model_version"], rest["active"], rest["policy"], rest["compute_us"]
    except (ValueError, TypeError, KeyError, msgpack.UnpackException):
        return None
    if tuple(map(type, found)) != (int, int, str, int) or len(found[2]) > 32:
        return None
    return found if all(0 <= number < 2**62 for number in (found[0], found[1], found[3])) else None


@lru_cache(64)
def _answer(outputs: int) -> tuple[list[tuple[int, bytes]], list[tuple[int, int]], int]:
    """Where the parts that never change stand, where the numbers do, and where the id ends."""
    fixed, runs, place = [], [], 1
    for name in _BEFORE:
        scalar = name == "novelty"
        width = 8 if scalar else 8 * outputs
        head = _array_head(name, width, scalar)
        fixed.append((place, head))
        place += len(head) + width
        runs.append((place - width, place))
    fixed.append((place, _ID_HEAD))
    return fixed, runs, place + len(_ID_HEAD) + 16


def state_bytes(message: Mapping[str, Any], dimensions: int) -> bytes | None:
    """The 8 d bytes of a request's one state, or None where its form is another that needs a full look."""
    states = message.get("states")
    if type(states) is not dict or states.get("dtype") != "<f8" or states.get("shape") != [dimensions]:
        return None
    data = states.get("data")
    return data if type(data) is bytes and len(data) == 8 * dimensions else None


def packed_rows(answer: Prediction, ids: Sequence[bytes], compute_us: int) -> Iterator[bytes]:
    """One reply a state, each as if its state had been asked about alone.

    Args:
        answer: For one state (d,) or for many (b, d).
        ids: b ids of 16 bytes.
        compute_us: Time of the model [us], for all of them.
    """
    last = _entry("compute_us", compute_us)
    tail = _scalars(answer.model_version, answer.active, answer.policy) + last
    tails = [tail] * len(ids)
    if answer.policy == "corrected" and answer.corrected is not None:  # of some goals only
        uncorrected = _scalars(answer.model_version, answer.active, "mean") + last
        tails = [tail if one else uncorrected for one in np.ravel(answer.corrected).tolist()]
    columns = [_column(name, getattr(answer, name), len(ids)) for name in _BEFORE]
    modelled = answer.predicted_outcome is not None
    after = _AFTER if modelled else ()
    outcomes = [_column(name, getattr(answer, name), len(ids)) for name in after]
    start = bytes([0x80 + len(columns) + 5 + len(outcomes)])  # the header of a map this small
    for row, identity in enumerate(ids):
        parts = [start]
        for head, data, width in columns:
            parts += (head, data[row * width : (row + 1) * width])
        parts += (_ID_HEAD, identity, tails[row])
        for head, data, width in outcomes:
            parts += (head, data[row * width : (row + 1) * width])
        yield b"".join(parts)


def _column(name: str, array: Array, count: int) -> tuple[bytes, bytes, int]:
    """What stands before each row's bytes, the bytes of all rows, and how many there are in a row."""
    data = array.astype("<f8", copy=False).tobytes()
    width = len(data) // count
    scalar = array.ndim == 0 or (array.ndim == 1 and width == 8 and name == "novelty")
    return _array_head(name, width, scalar), data, width


@lru_cache(256)
def _array_head(name: str, width: int, scalar: bool) -> bytes:
    """An array's entry up to its bytes."""
    entry = _entry(name, {"shape": [] if scalar else [width // 8], "dtype": "<f8", "data": bytes(width)})
    return entry[: len(entry) - width]


@lru_cache(256)
def _scalars(model_version: int, active: int, policy: str) -> bytes:
    """The same in every answer of a model."""
    return pack({"model_version": model_version, "active": active, "policy": policy})[1:]
