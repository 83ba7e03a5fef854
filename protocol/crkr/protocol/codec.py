"""Bytes on the wire: msgpack maps, arrays as {"shape", "dtype", "data"}, ids as 16 bytes; nothing that executes."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Final
from uuid import UUID

import msgpack
import numpy as np
from numpy.typing import NDArray

from crkr.protocol.errors import Invalid, Unsupported, shown
from crkr.protocol.keys import PROTOCOL_VERSION

__all__ = [
    "MAX_DEPTH",
    "MAX_MESSAGE_BYTES",
    "MAX_STATES",
    "MAX_TRIALS",
    "Array",
    "array_from_wire",
    "array_map",
    "array_to_wire",
    "check_depth",
    "check_encoding",
    "encoding",
    "frozen_from_wire",
    "id_from_wire",
    "is_masked",
    "pack",
    "pack_around",
    "salvage",
    "unpack",
    "unpack_request",
]

Array = NDArray[np.float64]

MAX_MESSAGE_BYTES: Final = 8 * 1024 * 1024
MAX_STATES: Final = 4096
MAX_TRIALS: Final = 1024
MAX_DEPTH: Final = 64  # nested maps and lists; some readers recurse
_MAX_CONTAINERS: Final = 2**17  # maps and lists of a request, 128 for each of its trials
_MAX_ENTRIES: Final = 2**16  # of one of them
_SLICE: Final = 2**16  # bytes decoded at a time: a millisecond or two
_MEDIA: Final = "application/msgpack"
_DTYPES: Final = {name: np.dtype(name) for name in ("<f8", "<f4", "<i8")}
_UNREADABLE: Final = (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException)
_ENCODING: Final = re.compile(rf"{_MEDIA};crkr\.[a-z_]+\.v([0-9]{{1,9}})")


def encoding(kind: str) -> str:
    """Zenoh encoding of a message, e.g. "application/msgpack;crkr.predict.v1"."""
    return f"{_MEDIA};crkr.{kind}.v{PROTOCOL_VERSION}"


@lru_cache(64)
def check_encoding(text: str) -> None:
    """Accepts this version's encodings, plain msgpack, and none at all (Zenoh then says "zenoh/bytes").

    Raises:
        Unsupported: Another version or another media type.
    """
    if text in ("", _MEDIA, "zenoh/bytes"):
        return
    match = _ENCODING.fullmatch(text)
    if match is None or int(match[1]) != PROTOCOL_VERSION:
        raise Unsupported(
            f"encoding {shown(text)} is not offered; this is {encoding('<type>')!r}",
            details={"protocol": PROTOCOL_VERSION, "encoding": text[:80]},
        )


def _default(value: object) -> object:
    if isinstance(value, np.ndarray):
        return array_to_wire(value)
    if isinstance(value, UUID):
        return value.bytes
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be sent: {shown(value)}")


def pack(message: Mapping[str, Any]) -> bytes:
    """Encodes a message; arrays become array maps, UUIDs 16 bytes.

    Raises:
        Invalid: Not plain data.
    """
    try:
        return bytes(msgpack.packb(message, default=_default, use_bin_type=True))
    except (TypeError, ValueError, OverflowError) as error:
        raise Invalid(f"message cannot be encoded: {error}") from error


def pack_around(message: Mapping[str, Any], name: str, packed: bytes | Sequence[bytes]) -> bytes:
    """`pack`, with one more field at the end, whose value (or each of whose entries) is encoded already.

    Raises:
        Invalid: Something in the message is not plain data.
    """
    if isinstance(packed, bytes):
        return pack({**message, name: None})[:-1] + packed
    count = len(packed)  # a nil is one byte, so a list of them is its header and one byte each
    return b"".join((pack({**message, name: [None] * count})[: -count or None], *packed))


def unpack(data: bytes, depth: int | None = MAX_DEPTH) -> dict[str, Any]:
    """Decodes one message.

    Args:
        data: The message's bytes.
        depth: Deepest nesting of maps and lists; None: msgpack's own 1024, for data stored before there was a limit.

    Raises:
        Invalid: Too large, not msgpack, not a map, nested too deep, or keys that are not text.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise Invalid(f"message has {len(data)} bytes; the limit is {MAX_MESSAGE_BYTES}")
    if not data:
        return {}
    try:
        message = msgpack.unpackb(data, raw=False, strict_map_key=True)
    except _UNREADABLE as error:
        raise Invalid(f"message is not msgpack with text keys: {type(error).__name__}: {error}") from error
    return _checked(message, depth)


def unpack_request(data: bytes) -> dict[str, Any]:
    """Decodes a client's message without blocking the server's other threads for long.

    msgpack holds the interpreter's lock while it decodes, so a large message is decoded in slices.

    Raises:
        Invalid: As `unpack`, or too many maps and lists.
    """
    if not _SLICE < len(data) <= MAX_MESSAGE_BYTES:
        return unpack(data)
    try:
        return _checked(_unpack_slices(data), MAX_DEPTH)
    except _UNREADABLE as error:
        raise Invalid(f"message is not msgpack with text keys: {type(error).__name__}: {error}") from error


def _unpack_slices(data: bytes) -> object:
    containers = 0

    def count(container: Any) -> Any:
        nonlocal containers
        containers += 1
        if containers > _MAX_CONTAINERS:
            raise Invalid(f"message has more than {_MAX_CONTAINERS} maps and lists; send less at once")
        return container

    unpacker = msgpack.Unpacker(
        raw=False,
        strict_map_key=True,
        object_hook=count,
        list_hook=count,
        max_buffer_size=len(data),
        max_array_len=_MAX_ENTRIES,
        max_map_len=_MAX_ENTRIES,
    )
    for start in range(0, len(data), _SLICE):
        unpacker.feed(data[start : start + _SLICE])
        try:
            message = unpacker.unpack()
        except msgpack.OutOfData:
            continue
        if unpacker.tell() != len(data):
            raise ValueError("there is more behind it")
        return message
    raise ValueError("it ends too early")


def _checked(message: object, depth: int | None) -> dict[str, Any]:
    if not isinstance(message, dict):
        raise Invalid(f"message must be a map with text keys; got {type(message).__name__}")
    for key in message:
        if type(key) is not str:
            raise Invalid(f"message must be a map with text keys; got a key of type {type(key).__name__}")
    if depth is not None:
        check_depth(message, depth)
    return message


def is_masked(value: object) -> bool:
    """Whether it is a masked array. Does not import `numpy.ma`, which few programs load."""
    kind = getattr(sys.modules.get("numpy.ma"), "MaskedArray", None)
    return kind is not None and isinstance(value, kind)


def salvage(data: bytes) -> dict[str, Any]:
    """Decodes what `unpack` refuses as far as msgpack can, for people to read; empty where it cannot."""
    try:
        found = msgpack.unpackb(data, strict_map_key=False, unicode_errors="replace")
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
        return {}
    return found if isinstance(found, dict) else {}


def check_depth(message: Mapping[str, Any], most: int = MAX_DEPTH) -> None:
    """Raises `Invalid` for a decoded message that is nested too deep; does not recurse."""
    level: list[Any] = [message]
    for _ in range(most):
        level = [
            value
            for outer in level
            for value in (outer.values() if type(outer) is dict else outer)
            if type(value) is dict or type(value) is list
        ]
        if not level:
            return
    raise Invalid(f"message is nested more than {most} deep")


def array_to_wire(array: NDArray[Any]) -> dict[str, Any]:
    """Encodes an array as its map: integers as <i8, float32 as <f4, other floats as <f8.

    Raises:
        TypeError: It is masked, or not of real numbers.
    """
    if is_masked(array) or array.dtype.kind not in "biuf":
        what = "a masked array" if is_masked(array) else f"an array of {array.dtype}"
        raise TypeError(f"{what} cannot be sent")
    if array.dtype.kind == "u" and array.dtype.itemsize == 8 and array.size and array.max() >= 2**63:
        raise TypeError("whole numbers of 2^63 and more cannot be sent in an array")
    dtype = "<i8" if array.dtype.kind in "iub" else "<f4" if array.dtype == np.float32 else "<f8"
    data = np.ascontiguousarray(array, dtype=dtype)
    return {"shape": list(array.shape), "dtype": dtype, "data": data.tobytes()}


def array_map(value: Mapping[str, Any], name: str) -> NDArray[Any]:
    """The array of a map, as a view of the message's bytes; raises `Invalid`."""
    shape, dtype, data = value.get("shape"), value.get("dtype"), value.get("data")
    known = _DTYPES.get(dtype) if isinstance(dtype, str) else None
    if known is None:
        raise Invalid(f"{name}.dtype must be one of {', '.join(_DTYPES)}; got {shown(dtype)}")
    if not isinstance(shape, list) or len(shape) > 4 or not _are_sizes(shape):
        raise Invalid(f"{name}.shape must be a list of at most 4 sizes; got {shown(shape)}")
    expected = known.itemsize * math.prod(shape)
    if not isinstance(data, bytes) or len(data) != expected:
        got = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
        raise Invalid(f"{name}.data must be {expected} bytes for shape {shape} of {dtype}; got {got}")
    flat = np.frombuffer(data, known)
    return flat if len(shape) == 1 else flat.reshape(shape)


def _are_sizes(shape: list[Any]) -> bool:
    for size in shape:  # noqa: SIM110 - a generator costs as much as the rest, and every array comes by here
        if type(size) is not int or not 0 <= size <= MAX_MESSAGE_BYTES:
            return False
    return True


def _from_list(value: Sequence[Any], name: str) -> Array:
    def numbers(items: Sequence[Any], depth: int) -> list[Any]:
        if depth > 2:
            raise Invalid(f"{name} is nested more than 2 deep")
        return [numbers(item, depth + 1) if isinstance(item, list | tuple) else number(item) for item in items]

    def number(item: object) -> float:
        if item is None:
            return float("nan")
        if isinstance(item, bool) or not isinstance(item, int | float):
            raise Invalid(f"{name} must hold numbers; got {type(item).__name__}")
        return float(item)

    try:
        return np.array(numbers(value, 1), dtype=np.float64)
    except (ValueError, OverflowError) as error:
        raise Invalid(f"{name} must be a regular list of numbers: {error}") from error


def array_from_wire(value: object, name: str) -> Array:
    """Decodes an array map or a nested list into a fresh float64 array; null becomes NaN, a numeric array is copied.

    Raises:
        Invalid: Another form, or sizes and bytes that disagree.
    """
    if isinstance(value, dict):
        return array_map(value, name).astype(np.float64)
    if isinstance(value, list | tuple):
        return _from_list(value, name)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return np.array(value, dtype=np.float64)
    if isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and not is_masked(value):
        return value.astype(np.float64)
    raise Invalid(f"{name} must be an array map or a list of numbers; got {type(value).__name__}")


def frozen_from_wire(value: object, name: str) -> Array:
    """As `array_from_wire`, but a read-only view of the message's bytes."""
    array = array_map(value, name) if type(value) is dict else array_from_wire(value, name)
    if array.dtype != np.float64:
        array = array.astype(np.float64)
    if array.flags.writeable:
        array.setflags(write=False)
    return array


def id_from_wire(value: object, name: str = "id") -> UUID:
    """Decodes an id.

    Raises:
        Invalid: Not 16 bytes.
    """
    if isinstance(value, UUID):
        return value
    if not isinstance(value, bytes) or len(value) != 16:
        got = f"{len(value)} bytes" if isinstance(value, bytes) else type(value).__name__
        raise Invalid(f"{name} must be 16 bytes (a UUID); got {got}")
    return UUID(bytes=value)
