"""An array that rows can be appended to in amortised constant time."""

from __future__ import annotations

from typing import Any, Final, final

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

__all__ = ["Growable"]

_FIRST_CAPACITY: Final = 64


@final
class Growable:
    """Rows of one shape and type, contiguous in memory.

    Capacity doubles; untouched pages cost no memory.

    Attributes:
        rows: View (n, ...) of the rows; stale after the next append.
    """

    __slots__ = ("_buffer", "rows")

    def __init__(self, dtype: DTypeLike, width: tuple[int, ...] = ()) -> None:
        self._buffer: NDArray[Any] = np.empty((_FIRST_CAPACITY, *width), dtype=dtype)
        self.rows: NDArray[Any] = self._buffer[:0]

    def __len__(self) -> int:
        return len(self.rows)

    def append(self, value: ArrayLike) -> None:
        """Adds one row."""
        count = len(self.rows)
        self._reserve(count + 1)
        self._buffer[count] = value
        self.rows = self._buffer[: count + 1]

    def extend(self, values: ArrayLike) -> None:
        """Adds several rows, copying them."""
        added = np.asarray(values, dtype=self._buffer.dtype)
        count = len(self.rows)
        self._reserve(count + len(added))
        self._buffer[count : count + len(added)] = added
        self.rows = self._buffer[: count + len(added)]

    def replace(self, values: ArrayLike) -> None:
        """Replaces all rows by copies of these."""
        self.rows = self._buffer[:0]
        self.extend(values)

    def detach(self) -> None:
        """Copies the rows, so that earlier views stay unchanged."""
        self._buffer = self._buffer.copy()
        self.rows = self._buffer[: len(self.rows)]

    def _reserve(self, count: int) -> None:
        if count > len(self._buffer):
            capacity = max(count, 2 * len(self._buffer))
            grown = np.empty((capacity, *self._buffer.shape[1:]), dtype=self._buffer.dtype)
            grown[: len(self.rows)] = self.rows
            self._buffer = grown
