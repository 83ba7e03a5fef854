"""The randomness of exploration, as a pure function of who asks: a repeated question gets the same answer.

The p uniforms of a trial come from SHAKE-128 [FIPS202] of 24 bytes: the task's seed as a little-endian unsigned 64-bit
integer (modulo 2^64) and the trial's id (16 bytes, in network order). Each 8 bytes of output, read as a little-endian
unsigned integer x, give one uniform ((x >> 12) + 1/2) / 2^52. That is strictly inside (0, 1) and exact in float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import shake_128
from typing import Final
from uuid import UUID

import numpy as np

from crkr.protocol import Array

__all__ = ["draw_ids", "uniforms"]

_VERSION_8: Final = 0x8 << 76 | 0x8 << 60  # version and variant
_FREE_BITS: Final = 2**128 - 1 - (0xF << 76) - (0xC << 60)


def uniforms(seed: int, trial_ids: Sequence[UUID], size: int) -> Array:
    """(b, size) numbers strictly inside (0, 1), a row for each of the b trials."""
    prefix = (seed % 2**64).to_bytes(8, "little")
    stream = b"".join(shake_128(prefix + trial_id.bytes).digest(8 * size) for trial_id in trial_ids)
    words = np.frombuffer(stream, dtype="<u8").reshape(len(trial_ids), size)
    return ((words >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52


def draw_ids(namespace: str, count: int) -> list[UUID]:
    """`count` version 8 UUIDs [RFC9562] that depend on the namespace only, which is all that SHAKE-128 is given."""
    stream = shake_128(namespace.encode()).digest(16 * count)
    return [_custom_uuid(int.from_bytes(stream[start : start + 16])) for start in range(0, 16 * count, 16)]


def _custom_uuid(bits: int) -> UUID:
    # Restored rather than constructed: the constructor's checks take longer than a state's share of a prediction.
    made = UUID.__new__(UUID)
    made.__setstate__({"int": bits & _FREE_BITS | _VERSION_8})  # type: ignore[attr-defined]  # typeshed lacks it
    return made
