"""Maps trial ids to rows in a dozen bytes per trial, a tenth of a Python dict.

Open addressing with linear probing; a slot holds a row number or -1. The ids themselves stay where they are stored.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

__all__ = ["IdIndex", "id_words"]

_FIRST_SLOTS: Final = 256
_MULTIPLIER: Final = 0x9E3779B97F4A7C15  # odd; used twice, it spreads ids of any pattern over the table
_WORD: Final = 2**64


def id_words(id_bytes: bytes) -> tuple[int, int]:
    """An id of 16 bytes as two unsigned integers."""
    return int.from_bytes(id_bytes[:8], "little"), int.from_bytes(id_bytes[8:], "little")


@final
class IdIndex:
    """Hash table over the rows of an array of ids, (n, 2) unsigned 64-bit words."""

    def __init__(self) -> None:
        self._slots: NDArray[np.int32] = np.full(_FIRST_SLOTS, -1, dtype=np.int32)
        self._count = 0

    def find(self, words: tuple[int, int], ids: NDArray[np.uint64]) -> int | None:
        """Row of an id, or None."""
        slot = self._probe(words, ids)
        row = int(self._slots[slot])
        return None if row < 0 else row

    def add(self, row: int, ids: NDArray[np.uint64]) -> None:
        """Adds `row`, whose id is not in the table yet."""
        if 2 * (self._count + 1) > len(self._slots):
            self._grow(ids[: self._count])
        self._slots[self._probe((int(ids[row, 0]), int(ids[row, 1])), ids)] = row
        self._count += 1

    def extend(self, ids: NDArray[np.uint64]) -> int | None:
        """Adds the rows of `ids` past those in the table; returns a row with a known id, or None."""
        first = self._count
        size = len(self._slots)
        while 2 * len(ids) > size:
            size *= 2
        if size > len(self._slots):
            self._slots = np.full(size, -1, dtype=np.int32)
            first = 0
        self._count = len(ids)
        return self._enter(np.arange(first, len(ids), dtype=np.int32), ids)

    def home(self, words: tuple[int, int]) -> int:
        """The slot where the search for an id starts."""
        spread = (words[0] + words[1] * _MULTIPLIER) % _WORD
        return ((spread ^ spread >> 32) * _MULTIPLIER % _WORD) >> 32 & (len(self._slots) - 1)

    def _probe(self, words: tuple[int, int], ids: NDArray[np.uint64]) -> int:
        """The slot of this id, or the free slot where it belongs."""
        mask = len(self._slots) - 1
        slot = self.home(words)
        while (row := self._slots[slot]) >= 0 and (ids[row, 0] != words[0] or ids[row, 1] != words[1]):
            slot = (slot + 1) & mask
        return slot

    def _grow(self, ids: NDArray[np.uint64]) -> None:
        """Doubles the slots and adds all rows again."""
        self._slots = np.full(2 * len(self._slots), -1, dtype=np.int32)
        self._enter(np.arange(len(ids), dtype=np.int32), ids)

    def _enter(self, rows: NDArray[np.int32], ids: NDArray[np.uint64]) -> int | None:
        """Adds many rows: a row that loses its slot to another tries the next. Stops at a row with a repeated id."""
        mask = np.uint64(len(self._slots) - 1)
        multiplier, half = np.uint64(_MULTIPLIER), np.uint64(32)
        spread = ids[rows, 0] + ids[rows, 1] * multiplier
        slots = ((spread ^ spread >> half) * multiplier >> half) & mask
        while len(rows):
            free = self._slots[slots] < 0
            self._slots[slots[free]] = rows[free]
            holders = self._slots[slots]
            waiting = holders != rows
            rows, slots, holders = rows[waiting], slots[waiting], holders[waiting]
            same = (ids[rows] == ids[holders]).all(axis=1)
            if same.any():
                return int(rows[same][0])
            slots = (slots + np.uint64(1)) & mask
        return None
