"""A trial's `info`: plain data that reads back as it was given.

Texts, truth values, whole numbers of 64 bits, floats, bytes, lists, maps with text keys, and arrays of numbers; a tuple
reads back as a list. On the wire an array is the codec's map {"shape", "dtype", "data"}, in Python it is an array.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgpack
import numpy as np
from numpy.typing import NDArray

from crkr.protocol.checks import shown
from crkr.protocol.codec import array_map, is_masked, pack
from crkr.protocol.errors import Invalid

__all__ = ["MAX_INFO_BYTES", "MAX_INFO_DEPTH", "check_info", "info_from_wire", "restored_info"]

MAX_INFO_BYTES: Final = 16 * 1024
MAX_INFO_DEPTH: Final = 32
_INTEGERS: Final = range(-(2**63), 2**64)  # what msgpack carries
_ARRAY_DIMENSIONS: Final = 4
_STEPS: Final = 8  # of a place that a message names
_SHOWN: Final = 40  # characters of a key in it
# (path of the outer value, key or index), and empty for the whole: it is put in words only for an error.
_Path = tuple[Any, ...]


def check_info(value: object) -> dict[str, Any]:
    """A copy of a program's `info`, as it will be read back.

    Raises:
        Invalid: Too large, nested too deep, or a value that would not read back equal; the message says where.
    """
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise Invalid(f"info must be a map with text keys; got {type(value).__name__}", details={"field": "info"})
    copied: dict[str, Any] = _Copy().of(value, (), 1)
    _check_size(copied)
    return copied


def info_from_wire(value: object) -> dict[str, Any]:
    """Checks what a message holds; its array maps become arrays.

    Raises:
        Invalid: As `check_info`.
    """
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise Invalid(f"info must be a map with text keys; got {type(value).__name__}", details={"field": "info"})
    _check_message(value, (), 1)
    _check_size(value)
    return restored_info(value)


def restored_info(value: Any) -> dict[str, Any]:
    """Stored `info`, with arrays for its array maps; rows of earlier versions may hold anything msgpack can."""
    if not isinstance(value, dict):
        raise Invalid(f"info must be a map; got {type(value).__name__}")
    return {key: _restored(entry, 1) for key, entry in value.items()}


def _restored(value: Any, depth: int) -> Any:
    if depth > MAX_INFO_DEPTH:  # of an earlier version, and left as it is
        return value
    if type(value) is dict:
        array = _array_of(value)
        return {key: _restored(entry, depth + 1) for key, entry in value.items()} if array is None else array
    if type(value) is list:
        return [_restored(entry, depth + 1) for entry in value]
    return value


def _array_of(value: Mapping[Any, Any]) -> NDArray[Any] | None:
    """The array that a map stands for; None for any other map."""
    if value.keys() != {"shape", "dtype", "data"}:
        return None
    try:
        array = array_map(value, "info").copy()  # a copy, so that the message can be freed
    except Invalid:
        return None
    array.setflags(write=False)
    return array


def _check_size(info: Mapping[str, Any]) -> None:
    size = len(pack(info))
    if size > MAX_INFO_BYTES:
        raise Invalid(f"info has {size} bytes; the limit is {MAX_INFO_BYTES}", details={"field": "info"})


def _check_message(value: Any, path: _Path, depth: int) -> None:
    """The same rules for decoded msgpack, which has few types."""
    kind = type(value)
    if kind is dict:
        _check_depth(path, depth)
        for key, entry in value.items():
            if type(key) is not str:
                raise _refused(path, f"keys must be text; got {type(key).__name__}")
            if type(entry) in (dict, list, msgpack.ExtType, msgpack.Timestamp):
                _check_message(entry, (path, key), depth + 1)
    elif kind is list:
        _check_depth(path, depth)
        for place, entry in enumerate(value):
            if type(entry) in (dict, list, msgpack.ExtType, msgpack.Timestamp):
                _check_message(entry, (path, place), depth + 1)
    else:
        raise _refused(path, f"cannot be encoded: {kind.__name__} is not plain data")


class _Copy:
    """Copies plain data; stops at the size limit of `info`, however often parts are shared."""

    def __init__(self) -> None:
        self._left = MAX_INFO_BYTES  # every value takes a byte or more

    def of(self, value: Any, path: _Path, depth: int) -> Any:
        self._spend(1)
        if value is None or type(value) in (bool, float):
            return value
        if isinstance(value, np.bool_):
            return bool(value)
        if isinstance(value, int | np.integer):
            return self._integer(int(value), path)
        if isinstance(value, float | np.floating):
            return _float(value, path)
        if isinstance(value, str):
            return self._text(value, path)
        if isinstance(value, bytes | bytearray):
            self._spend(len(value))
            return bytes(value)
        if isinstance(value, np.ndarray):
            return self._array(value, path)
        if isinstance(value, Mapping):
            return self._map(value, path, depth)
        if isinstance(value, list | tuple) and not isinstance(value, msgpack.ExtType):
            _check_depth(path, depth)
            self._spend(len(value))
            return [self.of(entry, (path, place), depth + 1) for place, entry in enumerate(value)]
        raise _refused(path, f"cannot be encoded: {type(value).__name__} is not plain data; give a text or numbers")

    def _spend(self, size: int) -> None:
        self._left -= size
        if self._left < 0:
            raise Invalid(f"info has more than its limit of {MAX_INFO_BYTES} bytes", details={"field": "info"})

    def _map(self, value: Mapping[Any, Any], path: _Path, depth: int) -> dict[str, Any]:
        _check_depth(path, depth)
        copied: dict[str, Any] = {}
        for key, entry in value.items():
            if not isinstance(key, str):
                raise _refused(path, f"must be a map with text keys; got a key of type {type(key).__name__}")
            copied[self._text(key, path)] = self.of(entry, (path, key), depth + 1)
        if _array_of(copied) is not None:
            raise _refused(path, "has the form in which arrays are sent; give the array, or other names")
        return copied

    def _integer(self, value: int, path: _Path) -> int:
        if value not in _INTEGERS:
            raise _refused(path, "must be a whole number of 64 bits; give larger ones as text")
        return value

    def _text(self, value: str, path: _Path) -> str:
        self._spend(len(value))
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise _refused(path, f"cannot be encoded: it is no Unicode text ({error.reason})") from error
        return str.__str__(value)  # an enumeration's value, not its name

    def _array(self, value: NDArray[Any], path: _Path) -> NDArray[Any]:
        if is_masked(value):
            raise _refused(path, "is a masked array; fill its gaps with NaN, or leave them out")
        if value.dtype.kind not in "biuf":
            raise _refused(path, f"must be an array of real numbers; got {value.dtype}")
        if value.ndim > _ARRAY_DIMENSIONS:
            raise _refused(path, f"must have at most {_ARRAY_DIMENSIONS} dimensions; got {value.ndim}")
        self._spend(value.size)
        kind = "<i8" if value.dtype.kind in "biu" else "<f4" if value.dtype == np.float32 else "<f8"
        with np.errstate(over="ignore"):
            copied = np.array(value, dtype=kind, order="C", subok=False)
        # Whole numbers are compared as such: uint64 beside int64 would be compared as floats.
        same = value.tolist() == copied.tolist() if kind == "<i8" else np.array_equal(value, copied, equal_nan=True)
        if not same:
            raise _refused(path, f"holds numbers of {value.dtype} beyond {kind}, as which they are kept")
        copied.setflags(write=False)
        return copied


def _float(value: Any, path: _Path) -> float:
    result = float(value)
    if result != value and result == result:  # of more bits than a float has
        raise _refused(path, f"must be a number of 64 bits; got {type(value).__name__}")
    return result


def _check_depth(path: _Path, depth: int) -> None:
    if depth > MAX_INFO_DEPTH:
        raise _refused(path, f"is nested more than {MAX_INFO_DEPTH} deep")


def _refused(path: _Path, why: str) -> Invalid:
    where = f"info{_words(path)}"
    return Invalid(f"{where} {why}", details={"field": where})


def _words(path: _Path) -> str:
    """A place in `info`, as `.torque[3]`; at most the first few steps of a long one."""
    steps: list[str | int] = []
    while path:
        path, step = path
        steps.append(step)
    words = [f"[{step}]" if isinstance(step, int) else f".{_key(step)}" for step in reversed(steps)]
    return "".join(words[:_STEPS]) + ("..." if len(words) > _STEPS else "")


def _key(key: str) -> str:
    name = key if key.isidentifier() else shown(key)
    return name if len(name) <= _SHOWN else name[:_SHOWN] + "..."
