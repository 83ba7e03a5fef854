"""Sends refusals at a limited rate.

A refused client asks again, as quickly as it was refused. With hundreds of open questions it would keep the server busy
with refusals alone, and delay everyone's predictions.

A waiting refusal keeps its whole query, as Zenoh cannot free the payload alone. So their number and bytes are bounded,
separately for large and small queries; beyond, queries are dropped unanswered, and their clients try again.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Final, final

from crkr.protocol import CrkrError
from crkr.server.thread_faults import FAULTS, keep_running

__all__ = ["Refuser"]

_PAUSE_S: Final = 0.004  # between batches
_TOGETHER: Final = 4  # at least
_PAUSES: Final = 80  # time to send all waiting refusals, within a client's first attempt
_MANY: Final = 4096  # waiting refusals from which on adding blocks a little, so that queries wait in their connections
_SLOWED_S: Final = 0.0001
_MOST_WAITING: Final = 16_384
_LARGE: Final = 16_384  # bytes of a query
# Bytes that may wait, for large and small queries: three of the largest messages, or some thousand small ones.
_MOST_BYTES: Final = {True: 26 * 2**20, False: 16 * 2**20}
_Tell = Callable[[CrkrError], None]


@final
class Refuser:
    """A thread that sends refusals; any thread may add one.

    A client that does not read its refusals blocks this thread only, so that others receive theirs later.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[_Tell, CrkrError]] = deque()
        self._sizes: deque[int] = deque()  # of their queries [bytes]
        self._bytes = {True: 0, False: 0}  # by whether the query is large
        # Most refusals waiting since the queue was last empty. It sets the rate, so that the last of many is not late.
        self._most = 0
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name="refusals", daemon=True)

    def __len__(self) -> int:
        """Number of waiting refusals."""
        return len(self._waiting)

    def start(self) -> None:
        """Start to send."""
        self._thread.start()

    def add(self, tell: _Tell, error: CrkrError, size: int = 0) -> bool:
        """Call `tell` with this error soon, or at once if the thread may have ended.

        Args:
            tell: Answers the query.
            error: The answer.
            size: Of the query [bytes].

        Returns:
            False if too many or too large ones wait already; `tell` is not called then.
        """
        with self._changed:
            queued = not self._closing.is_set()
            if queued:
                large = size > _LARGE
                if len(self._waiting) >= _MOST_WAITING or self._bytes[large] + size > _MOST_BYTES[large]:
                    return False
                self._waiting.append((tell, error))
                self._sizes.append(size)
                self._bytes[large] += size
                self._most = max(self._most, len(self._waiting))
                self._changed.notify()
        if not queued:
            tell(error)
        elif len(self._waiting) > _MANY:
            self._closing.wait(_SLOWED_S)
        return True

    def close(self, patience_s: float) -> None:
        """Send waiting refusals, for `patience_s` at most, and end."""
        self._closing.set()
        with self._changed:
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(patience_s)

    def _step(self) -> bool:
        batch = self.take()
        for tell, error in batch:
            try:
                tell(error)
            except BaseException as failure:  # the others are told
                FAULTS.note(failure)
        if batch:
            self._closing.wait(_PAUSE_S)
        return bool(batch)

    def take(self) -> list[tuple[_Tell, CrkrError]]:
        """Take the refusals to send before the next pause; waits for one."""
        with self._changed:
            while not (self._waiting or self._closing.is_set()):
                self._changed.wait()
            together = max(_TOGETHER, math.ceil(self._most / _PAUSES))
            batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), together))]
            for size in [self._sizes.popleft() for _ in batch]:
                self._bytes[size > _LARGE] -= size
            if not self._waiting:
                self._most = 0
            return batch
