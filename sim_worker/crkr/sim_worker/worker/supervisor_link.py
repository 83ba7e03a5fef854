"""A worker's link to its supervisor: orders, events, and patience while the server is away."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, TypeVar, final

from crkr.protocol import Busy, ShuttingDown, StorageError, Unavailable
from crkr.sim_worker.supervisor.child_process import MessagePipe

__all__ = ["Stopped", "SupervisorLink"]

Answer = TypeVar("Answer")

# Worth repeating with the same ids: the server may come back, or recover its queue or disk.
PASSING: Final = (Unavailable, Busy, ShuttingDown, StorageError)
PAUSE_S: Final = 0.5
CHECK_S: Final = 5.0


class Stopped(Exception):
    """The supervisor wants this process to end."""


@final
class SupervisorLink:
    """Orders from the supervisor, and events to it.

    Args:
        pipe: This process's end.
        patience_s: How long the server may be away before a call fails [s].
    """

    def __init__(self, pipe: MessagePipe, patience_s: float) -> None:
        self._pipe = pipe
        self._patience_s = patience_s
        self._judgements: deque[dict[str, Any]] = deque()  # first, so that the model of that moment is asked
        self._others: deque[dict[str, Any]] = deque()

    def send(self, event: str, **fields: Any) -> None:
        """Sends an event; raises `PipeClosed`."""
        self._pipe.send({"event": event, **fields})

    def next_order(self) -> dict[str, Any]:
        """Waits for the next order; raises `Stopped` or `PipeClosed`."""
        self._read()
        while not (self._judgements or self._others):
            self._read(CHECK_S)
        return (self._judgements or self._others).popleft()

    def has_order(self) -> bool:
        """Whether an order waits; raises `Stopped` or `PipeClosed`."""
        self._read()
        return bool(self._judgements or self._others)

    def retry_while_away(self, ask: Callable[[], Answer]) -> Answer:
        """Retries `ask` until the server answers; tells the supervisor once that it is away.

        Raises:
            CrkrError: The server refuses, or is away for longer than the patience.
            Stopped: The supervisor wants this process to end.
        """
        away_since: float | None = None
        while True:
            try:
                answer = ask()
            except PASSING as error:
                now = time.monotonic()
                if away_since is None:
                    away_since = now
                    self.send("away", reason=error.message)
                if now - away_since > self._patience_s:
                    raise
                self._read(PAUSE_S)
            else:
                if away_since is not None:
                    self.send("back", seconds=time.monotonic() - away_since)
                return answer

    def _read(self, timeout_s: float = 0.0) -> None:
        """Reads all orders, waiting up to `timeout_s` for the first; raises `Stopped` or `PipeClosed`."""
        while (message := self._pipe.receive(timeout_s)) is not None:
            if message["order"] == "stop":
                raise Stopped
            (self._judgements if message["order"] == "judge" else self._others).append(message)
            timeout_s = 0.0
