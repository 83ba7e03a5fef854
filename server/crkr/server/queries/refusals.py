"""Tells those who asked too much, or for what there is not, at a measured pace.

Who is refused asks again, and who is refused at once asks again at once: a client that keeps hundreds of questions
outstanding would then occupy the server with refusals alone, and every other client's predictions with it.

A refusal that waits keeps its whole query, as Zenoh has no way to let go of the payload alone. So their number and
their bytes are bounded, those of large queries apart from those of small ones; beyond that the caller lets go of the
query without a word, and its asker tries again.
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

_PAUSE_S: Final = 0.004  # between those told together
_TOGETHER: Final = 4  # at least
_PAUSES: Final = 80  # in which all are told who wait: a client that waits for BUSY hears it within its first attempt
_MANY: Final = 4096  # that wait, from which on who adds is slowed: its queries wait in their connections then
_SLOWED_S: Final = 0.0001
_MOST_WAITING: Final = 16_384
_LARGE: Final = 16_384  # bytes of a query
_MOST_BYTES: Final = 16 * 2**20  # of the large queries that wait, and again of the small ones
_Tell = Callable[[CrkrError], None]


@final
class Refuser:
    """One thread that tells what was refused; any thread may add to it.

    Who does not read holds it up, and nobody else: others hear of their refusal later then, and ask again anyway.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[_Tell, CrkrError]] = deque()
        self._sizes: deque[int] = deque()  # of their queries [bytes]
        self._bytes = {True: 0, False: 0}  # by whether the query is large
        # That waited at a time since last nobody did. It sets the pace, or the last of many would wait long.
        self._most = 0
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name="refusals", daemon=True)

    def start(self) -> None:
        """Begins to answer."""
        self._thread.start()

    def add(self, tell: _Tell, error: CrkrError, size: int = 0) -> bool:
        """Calls `tell` with this error before long; at once where the thread may have ended.

        Args:
            tell: Answers the query.
            error: What it is answered with.
            size: Of the query [bytes].

        Returns:
            False: too many wait already, or too large ones, and `tell` will not be called.
        """
        with self._changed:
            queued = not self._closing.is_set()
            if queued:
                large = size > _LARGE
                if len(self._waiting) >= _MOST_WAITING or self._bytes[large] + size > _MOST_BYTES:
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
        """Answers all that wait, for `patience_s` at most, and ends."""
        self._closing.set()
        with self._changed:
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(patience_s)

    def _step(self) -> bool:
        batch = self._take()
        for tell, error in batch:
            try:
                tell(error)
            except BaseException as failure:  # the others are told
                FAULTS.note(failure)
        if batch:
            self._closing.wait(_PAUSE_S)
        return bool(batch)

    def _take(self) -> list[tuple[_Tell, CrkrError]]:
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
