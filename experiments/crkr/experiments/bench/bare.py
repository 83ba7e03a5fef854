"""Zenoh without anything of ours: one question at a time, or many in flight."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from types import TracebackType
from typing import Any, Final, Self, final

import zenoh

from crkr.client.network.config import Connection
from crkr.protocol import Internal

__all__ = ["Bare", "outcome"]

_TIMEOUT_S: Final = 10.0
_CONNECT_S: Final = 5.0


@final
class Bare:
    """One session with one querier for one key; a context manager.

    Args:
        endpoint: Of the server.
        key: What is asked.
    """

    def __init__(self, endpoint: str, key: str) -> None:
        self._session = zenoh.open(Connection(endpoint).zenoh(_CONNECT_S))
        self._querier = self._session.declare_querier(
            key,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_TIMEOUT_S,
        )

    def send(self, payload: bytes) -> Any:
        """Sends a query; the channel of its replies."""
        return self._querier.get(zenoh.handlers.FifoChannel(4), payload=payload)

    def ask(self, payload: bytes) -> bytes:
        """One question, one answer."""
        return outcome(self.send(payload).recv())

    def rate(self, payloads: Iterable[bytes], in_flight: int) -> float:
        """Answers a second [1/s], with so many questions in flight all the time."""
        waiting: deque[Any] = deque()
        started, count = time.perf_counter(), 0
        for payload in payloads:
            if len(waiting) == in_flight:
                outcome(waiting.popleft().recv())
            waiting.append(self.send(payload))
            count += 1
        while waiting:
            outcome(waiting.popleft().recv())
        return count / (time.perf_counter() - started)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type


def outcome(reply: zenoh.Reply) -> bytes:
    """The bytes of an answer; raises `Internal` for an error reply, which no measurement should meet."""
    if reply.ok is None:
        said = b"" if reply.err is None else reply.err.payload.to_bytes()
        raise Internal(f"a measured query was refused: {said[:200]!r}")
    return reply.ok.payload.to_bytes()
