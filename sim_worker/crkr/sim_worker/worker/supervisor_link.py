"""A worker's side of its line: what the launcher wants, and patience while the server is away."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, TypeVar, final

from crkr.protocol import Busy, ShuttingDown, StorageError, Unavailable
from crkr.sim_worker.supervisor.pipe import Line

__all__ = ["Orders", "Stopped"]

Answer = TypeVar("Answer")

# Worth asking again with the same ids: the server may come back, drain its queue, or get its disk back.
PASSING: Final = (Unavailable, Busy, ShuttingDown, StorageError)
PAUSE_S: Final = 0.5
CHECK_S: Final = 5.0


class Stopped(Exception):
    """The launcher wants this process to end."""


@final
class Orders:
    """Orders from the launcher, and events to it.

    Args:
        line: This process's end.
        patience_s: How long the server may be away before a call fails [s].
    """

    def __init__(self, line: Line, patience_s: float) -> None:
        self._line = line
        self._patience_s = patience_s
        self._judgements: deque[dict[str, Any]] = deque()  # go first, so that the model of that moment is asked
        self._others: deque[dict[str, Any]] = deque()

    def tell(self, event: str, **fields: Any) -> None:
        """Sends an event; raises `LineClosed`."""
        self._line.send({"event": event, **fields})

    def look(self, timeout_s: float = 0.0) -> None:
        """Reads what has come, waiting up to `timeout_s` for the first; raises `Stopped` or `LineClosed`."""
        while (message := self._line.receive(timeout_s)) is not None:
            if message["order"] == "stop":
                raise Stopped
            (self._judgements if message["order"] == "judge" else self._others).append(message)
            timeout_s = 0.0

    def next(self) -> dict[str, Any]:
        """The next order, however long it takes; raises `Stopped` or `LineClosed`."""
        self.look()
        while not (self._judgements or self._others):
            self.look(CHECK_S)
        return (self._judgements or self._others).popleft()

    def waiting(self) -> bool:
        """Whether an order is there to be read; raises `Stopped` or `LineClosed`."""
        self.look()
        return bool(self._judgements or self._others)

    def insist(self, ask: Callable[[], Answer]) -> Answer:
        """Repeats a call with the same content while the server is away, and tells the launcher once.

        Raises:
            CrkrError: The server's refusal, or its absence for longer than the patience.
            Stopped: The launcher wants this process to end.
        """
        away_since: float | None = None
        while True:
            try:
                answer = ask()
            except PASSING as error:
                now = time.monotonic()
                if away_since is None:
                    away_since = now
                    self.tell("away", reason=error.message)
                if now - away_since > self._patience_s:
                    raise
                self.look(PAUSE_S)
            else:
                if away_since is not None:
                    self.tell("back", seconds=time.monotonic() - away_since)
                return answer
