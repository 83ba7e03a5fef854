"""Predictions for many single states as bytes, many times faster than one map each, and the same bytes.

A reply's bytes differ from its neighbour's in the numbers and the id only; everything between is packed once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

from crkr.protocol import Array, Prediction, pack

__all__ = ["packed_rows", "state_bytes"]


def _entry(name: str, value: object) -> bytes:
    """One entry of a map, without the map."""
    return pack({name: value})[1:]


_ID_HEAD: Final = _entry("trial_ids", [bytes(16)])[:-16]


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
    tail = _scalars(answer.model_version, answer.active, answer.policy) + _entry("compute_us", compute_us)
    columns = [_column(name, getattr(answer, name), len(ids)) for name in ("goals", "means", "sigmas", "novelty")]
    modelled = answer.predicted_outcome is not None
    after = ("predicted_outcome", "predicted_outcome_sd") if modelled else ()
    outcomes = [_column(name, getattr(answer, name), len(ids)) for name in after]
    start = bytes([0x80 + len(columns) + 5 + len(outcomes)])  # the header of a map this small
    for row, identity in enumerate(ids):
        parts = [start]
        for head, data, width in columns:
            parts += (head, data[row * width : (row + 1) * width])
        parts += (_ID_HEAD, identity, tail)
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
