"""The client's only view of Zenoh: a query is bytes to bytes by a deadline, a publication is bytes that may be lost.

reply                                what the transport does
ok                                   returns its bytes
error BUSY, SHUTTING_DOWN            waits as told, sends the same bytes again
other error                          raises its exception
none (EMPTY) or Zenoh's "Timeout"    outcome unknown: sends the same bytes again
deadline reached                     raises Unavailable
"""

from __future__ import annotations

import logging
import os
import random
import time
from typing import Final, final

import zenoh

from crkr.client.config import Connection, brief
from crkr.client.session import NotConnected, Session
from crkr.protocol import (
    MAX_MESSAGE_BYTES,
    Busy,
    Internal,
    Invalid,
    ShuttingDown,
    Unavailable,
    check_encoding,
    encoding,
    error_from_wire,
    unpack,
)
from crkr.protocol.call_metadata import CallMetadata

__all__ = ["Transport"]

_logger = logging.getLogger(__name__)
_FIRST_ATTEMPT_S: Final = 0.5
_LATER_ATTEMPT_S: Final = 1.0
_FIRST_PAUSE_S: Final = 0.02
_LONGEST_PAUSE_S: Final = 0.25


class _Unanswered(Exception):
    """This attempt brought no answer; `pause_s` is when the server asked to be tried again."""

    def __init__(self, reason: str, pause_s: float | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.pause_s = pause_s


@final
class Transport:
    """Queries and publications over one session; safe to use from many threads.

    Attributes:
        session: The Zenoh session beneath.
    """

    def __init__(self, connection: Connection) -> None:
        self.session: Final = Session(connection)
        self._client = os.urandom(16)  # tells the server which calls are one client's

    @property
    def endpoint(self) -> str:
        """Where the server is."""
        return self.session.connection.endpoint

    def query(self, key: str, kind: str, payload: bytes, deadline: float, *, patient: bool = False) -> bytes:
        """Sends a query until it is answered.

        Args:
            key: Where to.
            kind: Name of the message for its encoding, e.g. "predict".
            payload: The message; the same bytes in every attempt.
            deadline: When to give up [s, monotonic clock].
            patient: One attempt may take all the time: for calls that work long. A lost connection still ends it. The
                server is told how long the attempt lasts, and drops what would be answered too late.

        Raises:
            Invalid: The message is too large.
            Unavailable: No answer in time; whether the request was executed is unknown.
            CrkrError: The server's typed error.
        """
        if len(payload) > MAX_MESSAGE_BYTES:
            raise Invalid(f"{kind} message has {len(payload)} bytes; the limit is {MAX_MESSAGE_BYTES}: split it")
        started = time.monotonic()
        reason = "no time"
        attempt = 0
        while True:
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                raise self._unavailable(key, time.monotonic() - started, attempt, reason)
            limit = remaining if patient else _LATER_ATTEMPT_S if attempt else _FIRST_ATTEMPT_S
            try:
                return self._attempt(key, kind, payload, min(limit, remaining), patient)
            except _Unanswered as unanswered:
                reason = unanswered.reason
                pause = _pause(attempt) if unanswered.pause_s is None else unanswered.pause_s
                if attempt == 0:
                    _logger.info("%s at %s: %s; trying again", key, self.endpoint, reason)
                self.session.pause(min(pause, max(0.0, deadline - time.monotonic())))
            attempt += 1

    def _attempt(self, key: str, kind: str, payload: bytes, timeout_s: float, patient: bool) -> bytes:
        try:
            session = self.session.open(time.monotonic() + timeout_s)
            told = CallMetadata(self._client, max(1, int(1000 * timeout_s))).to_bytes() if patient else None
            with self.session.inside:
                replies = session.get(
                    key,
                    zenoh.handlers.FifoChannel(4),
                    payload=payload,
                    encoding=encoding(kind),
                    consolidation=zenoh.ConsolidationMode.NONE,  # hands over the reply without waiting for the end
                    timeout=timeout_s,
                    attachment=told,
                )
                reply = replies.recv()
        except NotConnected as error:
            raise _Unanswered(str(error)) from error
        except zenoh.ZError as error:
            raise _Unanswered(self._silence(session, error)) from error
        return _open_reply(reply, key)

    def _silence(self, session: zenoh.Session, error: zenoh.ZError) -> str:
        if session.is_closed():
            return "the session was closed"
        if "empty and closed" not in str(error):
            return brief(error)
        if not session.info.routers_zid():
            return "not connected"
        return "connected, but nobody serves this key, or the server's access control denies it to this client"

    def _unavailable(self, key: str, tried_s: float, attempts: int, reason: str) -> Unavailable:
        details = {
            "endpoint": self.endpoint,
            "key": key,
            "tried_s": tried_s,
            "attempts": attempts,
            "reason": reason,
        }
        if self.session.peek() is None:
            message = (
                f"no server at {self.endpoint} within {tried_s:.1f} s; start one: crkr server, or ask why: crkr doctor"
            )
            return Unavailable(message, details=details)
        ask = "" if reason.startswith("connected") else "is the server running? "
        return Unavailable(
            f"no answer from {self.endpoint} to {key} in {tried_s:.1f} s and {attempts} attempts ({reason}); "
            f"{ask}`crkr doctor` tells more",
            details=details,
        )

    def publish(self, key: str, kind: str, payload: bytes) -> None:
        """Publishes if there is a connection, and drops it where there is none or it is congested; never waits."""
        session = self.session.peek()
        if session is None:
            _logger.debug("not connected: dropped a publication on %s", key)
            return
        try:
            session.put(
                key,
                payload,
                encoding=encoding(kind),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,  # a picture never delays a report
            )
        except zenoh.ZError as error:
            _logger.debug("dropped a publication on %s: %s", key, brief(error))

    def connect(self, deadline: float) -> zenoh.Session:
        """The open session, for tokens and subscriptions.

        Raises:
            Unavailable: No connection by the deadline.
        """
        started = time.monotonic()
        attempt = 0
        while True:
            try:
                return self.session.open(deadline)
            except NotConnected as error:
                if time.monotonic() >= deadline:
                    raise self._unavailable(
                        "its session", time.monotonic() - started, attempt + 1, str(error)
                    ) from error
            self.session.pause(min(_pause(attempt), max(0.0, deadline - time.monotonic())))
            attempt += 1

    def close(self) -> None:
        """Closes the session."""
        self.session.close()


def _pause(attempt: int) -> float:
    """Doubling pauses with jitter, so that a fleet does not come back in step."""
    return min(_LONGEST_PAUSE_S, _FIRST_PAUSE_S * 2.0 ** min(attempt, 10)) * random.uniform(0.75, 1.25)


def _open_reply(reply: zenoh.Reply, key: str) -> bytes:
    if reply.ok is not None:
        check_encoding(str(reply.ok.encoding))
        return reply.ok.payload.to_bytes()
    if reply.err is None:
        raise _Unanswered("an empty reply")
    body = reply.err.payload.to_bytes()
    if body == b"Timeout":  # Zenoh's own, when the attempt's time is over
        raise _Unanswered("connected, but no reply in time")
    try:
        error = error_from_wire(unpack(body))
    except Invalid as unreadable:
        raise Internal(f"unreadable error reply to {key}: {unreadable.message}") from unreadable
    if isinstance(error, Busy | ShuttingDown):
        pause = None if error.retry_ms is None else min(max(error.retry_ms, 1), 1000) / 1000
        raise _Unanswered(f"{error.code}: {error.message}", pause)
    raise error
