"""The randomness of exploration, as a pure function of who asks: a repeated question gets the same answer.

The p uniforms of a trial come from SHAKE-128 [FIPS202] of 24 bytes: the task's seed as a little-endian unsigned 64-bit
integer (modulo 2^64) and the trial's id (16 bytes, in network order). Each 8 bytes of output, read as a little-endian
unsigned integer x, give one uniform ((x >> 12) + 1/2) / 2^52. That is strictly inside (0, 1) and exact in float64.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from hashlib import shake_128
from itertools import repeat
from struct import iter_unpack
from typing import Final
from uuid import UUID, SafeUUID

import numpy as np

from crkr.protocol import Array

__all__ = ["draw_ids", "uniforms"]

_MANY: Final = 16
_VERSION_8: Final = 0x8 << 12
_FREE_HIGH: Final = 2**64 - 1 - (0xF << 12)
_VARIANT: Final = 0x8 << 60
_FREE_LOW: Final = 2**62 - 1
_set_int, _set_safety = UUID.__dict__["int"].__set__, UUID.__dict__["is_safe"].__set__


def uniforms(seed: int, trial_ids: Sequence[UUID], size: int) -> Array:
    """(b, size) numbers strictly inside (0, 1), a row for each of the b trials."""
    prefix = (seed % 2**64).to_bytes(8, "little")
    stream = b"".join(shake_128(prefix + trial_id.bytes).digest(8 * size) for trial_id in trial_ids)
    words = np.frombuffer(stream, dtype="<u8").reshape(len(trial_ids), size)
    return ((words >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52


def draw_ids(namespace: str, count: int) -> list[UUID]:
    """`count` version 8 UUIDs [RFC9562] that depend on the namespace only, which is all that SHAKE-128 is given."""
    stream = shake_128(namespace.encode()).digest(16 * count)
    return _few_ids(stream) if count < _MANY else _many_ids(stream)


def _few_ids(stream: bytes) -> list[UUID]:
    ids = []
    for high, low in iter_unpack(">QQ", stream):
        # Filled in rather than constructed: the constructor's checks take as long as a state's share of a prediction.
        made = object.__new__(UUID)
        _set_int(made, (high & _FREE_HIGH | _VERSION_8) << 64 | low & _FREE_LOW | _VARIANT)
        _set_safety(made, SafeUUID.unknown)
        ids.append(made)
    return ids


def _many_ids(stream: bytes) -> list[UUID]:
    """The same without a step of the interpreter for each, which pays where there are some."""
    octets = np.frombuffer(stream, dtype=np.uint8).reshape(-1, 16).copy()
    octets[:, 6] = octets[:, 6] & 0x0F | 0x80
    octets[:, 8] = octets[:, 8] & 0x3F | 0x80
    ids = list(map(object.__new__, repeat(UUID, len(octets))))
    numbers = map(int.from_bytes, octets.view("V16")[:, 0].tolist())
    for done in (map(_set_int, ids, numbers), map(_set_safety, ids, repeat(SafeUUID.unknown))):
        deque(done, maxlen=0)
    return ids
