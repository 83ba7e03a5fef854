"""Values, bytes, encodings and keys that nobody should send, and some that are only unusual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import msgpack
import numpy as np

MIB: Final = 2**20

FLOATS: Final = (float("nan"), float("inf"), float("-inf"), -0.0, 5e-324, -5e-324, 1e-308, 1e308, -1.7e308, 1e154)
WHOLE: Final = (-1, 0, 1, 2, 255, 2**31, 2**32, 2**53 + 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1, -(2**63))
TEXTS: Final = ("", "a", "\x00", "\x1b[2J\x07", "../../etc", "*", "ünïcödé", "\u202ereversed", "x" * 63, "x" * 70_000)
BYTES: Final = (b"", b"\xff", bytes(15), bytes(16), b"x" * 17, b"\x80" * 70_000)


def nested(depth: int, value: Any = 0, *, maps: bool = False) -> Any:
    """A value nested in that many lists or maps."""
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
HUGE: Final = (8 * MIB, 8 * MIB + 1, 8 * MIB + 200_000)  # bytes; beyond, Zenoh need not hand it over
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
    *("x" * 59_000, "task/" + "x" * 59_000 + "/rpc/predict", "task/" + "/".join("abcdefgh" * 20) + "/rpc/predict"),
)
