"""Tells those who asked too much, or for what there is not, at a measured pace.

Who is refused asks again, and who is refused at once asks again at once: a client that keeps hundreds of questions
outstanding would then occupy the server with refusals alone, and every other client's predictions with it.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Final, final

from crkr.protocol import CrkrError

__all__ = ["Refuser"]

logger = logging.getLogger(__name__)

_PAUSE_S: Final = 0.004  # between those told together
_TOGETHER: Final = 4  # at least
_PAUSES: Final = 80  # in which all are told who wait: a client that waits for BUSY hears it within its first attempt
_MANY: Final = 4096  # that wait, from which on who adds is slowed: its queries wait in their connections then
_SLOWED_S: Final = 0.0001
_Tell = Callable[[CrkrError], None]


@final
class Refuser:
    """One thread that tells what was refused; any thread may add to it.

    Who does not read holds it up, and nobody else: others hear of their refusal later then, and ask again anyway.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[_Tell, CrkrError]] = deque()
        # That waited at a time since last nobody did. It sets the pace, or the last of many would wait long.
        self._most = 0
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="refusals", daemon=True)

    def start(self) -> None:
        """Begins to answer."""
        self._thread.start()

    def add(self, tell: _Tell, error: CrkrError) -> None:
        """Calls `tell` with this error before long; at once where the thread may have ended."""
        with self._changed:
            queued = not self._closing.is_set()
            if queued:
                self._waiting.append((tell, error))
                self._most = max(self._most, len(self._waiting))
                self._changed.notify()
        if not queued:
            tell(error)
        elif len(self._waiting) > _MANY:
            self._closing.wait(_SLOWED_S)

    def close(self, patience_s: float) -> None:
        """Answers all that wait, for `patience_s` at most, and ends."""
        self._closing.set()
        with self._changed:
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(patience_s)

    def _run(self) -> None:
        while batch := self._take():
            for tell, error in batch:
                try:
                    tell(error)
                except Exception:  # the others are told
                    logger.exception("%s could not be told", error.code)
            self._closing.wait(_PAUSE_S)

    def _take(self) -> list[tuple[_Tell, CrkrError]]:
        with self._changed:
            while not (self._waiting or self._closing.is_set()):
                self._changed.wait()
            together = max(_TOGETHER, math.ceil(self._most / _PAUSES))
            batch = [self._waiting.popleft() for _ in range(min(len(self._waiting), together))]
            if not self._waiting:
                self._most = 0
            return batch
