"""The transport over Zenoh: a query is bytes to bytes by a deadline, a publication is bytes that may be lost.

reply                                what the transport does
ok                                   returns its bytes
error BUSY, SHUTTING_DOWN            waits as told, sends the same bytes again
other error                          raises its exception
no reply, or Zenoh's own "Timeout"    outcome unknown: sends the same bytes again
deadline reached                     raises Unavailable
"""

from __future__ import annotations

import logging
import os
import random
import time
from collections.abc import Sequence
from typing import Final, final

import zenoh

from crkr.client.lifetimes import Closing
from crkr.client.network.config import Connection, brief
from crkr.client.network.diagnosis import silence_of
from crkr.client.network.presence import Presence
from crkr.client.network.role import Role
from crkr.client.network.session import NotConnected, Session, declare
from crkr.client.network.subscription import Subscription
from crkr.client.network.trust import EVERYONE, NotTheServer, Trust
from crkr.protocol import (
    MAX_MESSAGE_BYTES,
    Busy,
    Internal,
    Invalid,
    ShuttingDown,
    Unavailable,
    Unsupported,
    check_encoding,
    encoding,
    error_from_wire,
    unpack,
)
from crkr.protocol.messages.call_metadata import CallMetadata

__all__ = ["ZenohTransport"]

_logger = logging.getLogger(__name__)
_FIRST_ATTEMPT_S: Final = 0.5
_LATER_ATTEMPT_S: Final = 1.0
_FIRST_PAUSE_S: Final = 0.02
_LONGEST_PAUSE_S: Final = 0.25
_LOOK_AGAIN_S: Final = 1.0


class _Unanswered(Exception):
    """This attempt brought no answer.

    Attributes:
        reason: Why not.
        pause_s: The pause that the server asked for.
        timed_out: Zenoh was connected and waited in vain.
    """

    def __init__(self, reason: str, pause_s: float | None = None, *, timed_out: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.pause_s = pause_s
        self.timed_out = timed_out


@final
class ZenohTransport(Closing):
    """Queries and publications over one session; safe to use from many threads."""

    def __init__(self, connection: Connection) -> None:
        self.session: Final = Session(connection)
        self._trust = Trust()
        self._found: tuple[float, str] | None = None
        self._timeouts = 0  # of attempts since the last answer
        self._client = os.urandom(16)  # tells the server which calls come from this client

    @property
    def endpoint(self) -> str:
        """Where the server is."""
        return self.session.connection.endpoint

    def query(
        self, key: str, kind: str, payload: bytes, deadline: float, *, patient: bool = False, optional: bool = False
    ) -> bytes:
        """As `Transport.query`.

        The server learns how long a patient attempt lasts, and drops late requests. A lost connection
        ends such an attempt too.
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
                answer = self._attempt(key, kind, payload, min(limit, remaining), patient=patient, optional=optional)
            except _Unanswered as unanswered:
                if attempt == 0 or limit <= remaining:  # one that the deadline cut short tells less
                    reason = unanswered.reason
                pause = _pause(attempt) if unanswered.pause_s is None else unanswered.pause_s
                if attempt == 0:
                    _logger.info("%s at %s: %s; trying again", key, self.endpoint, reason)
                self._timeouts = self._timeouts + 1 if unanswered.timed_out else 0
                if self._timeouts > 1:
                    self.session.suspect()
                self.session.pause(min(pause, max(0.0, deadline - time.monotonic())))
            else:
                self._timeouts = 0
                return answer
            attempt += 1

    def _attempt(
        self, key: str, kind: str, payload: bytes, timeout_s: float, *, patient: bool, optional: bool
    ) -> bytes:
        try:
            session = self.session.open(time.monotonic() + timeout_s)
            told = CallMetadata(self._client, max(1, int(1000 * timeout_s))).to_bytes() if patient else None
            with self.session.calls:
                replies = session.get(
                    key,
                    zenoh.handlers.FifoChannel(4),
                    payload=payload,
                    encoding=encoding(kind),
                    consolidation=zenoh.ConsolidationMode.NONE,  # hands over the reply without waiting for the end
                    target=EVERYONE,
                    timeout=timeout_s,
                    attachment=told,
                )
                others: dict[str, zenoh.Reply] = {}
                try:
                    reply = self._trust.pick(session, replies, others)
                finally:
                    del replies  # or Zenoh would wait for their reader
                    if others:
                        self._trust.tell_of_strangers(session, others)
        except NotConnected as error:
            raise _Unanswered(str(error)) from error
        except NotTheServer as error:
            raise _Unanswered(f"connected, but {error}") from error
        except zenoh.ZError as error:
            if optional and _nobody_serves(session, error):
                raise Unsupported(f"{self.endpoint} does not serve {key} to this client") from error
            raise _Unanswered(self._silence(session, error, timeout_s)) from error
        return _open_reply(reply, key)

    def _silence(self, session: zenoh.Session, error: zenoh.ZError, patience_s: float) -> str:
        if session.is_closed():
            return "the session was closed"
        if not _is_empty(error):
            return brief(error)
        if not session.info.routers_zid():
            return "not connected"
        return self._why_silent(session, patience_s)

    def _why_silent(self, session: zenoh.Session, patience_s: float) -> str:
        """Why the connected router does not answer; checked once a second."""
        now = time.monotonic()
        if self._found is None or now - self._found[0] > _LOOK_AGAIN_S:
            try:
                with self.session.calls:
                    self._found = now, silence_of(session, patience_s)
            except NotConnected as closed:
                return str(closed)
        return self._found[1]

    def _unavailable(self, key: str, tried_s: float, attempts: int, reason: str) -> Unavailable:
        details = {
            "endpoint": self.endpoint,
            "key": key,
            "tried_s": tried_s,
            "attempts": attempts,
            "reason": reason,
        }
        if self.session.peek() is None:
            found = self.session.obstacle
            what = "; start one: crkr server, or ask why: crkr doctor"
            if found is not None and not found.absent:
                what = f": {found.what} (`crkr doctor` tells more)"
            message = f"no server at {self.endpoint} within {tried_s:.1f} s{what}"
            return Unavailable(message, details=details)
        ask = "" if reason.startswith("connected") else "is the server running? "
        return Unavailable(
            f"no answer from {self.endpoint} to {key} in {tried_s:.1f} s and {attempts} attempts ({reason}); "
            f"{ask}`crkr doctor` tells more",
            details=details,
        )

    def publish(self, key: str, kind: str, payload: bytes) -> None:
        """As `Transport.publish`; without a connection, or with a congested one, the message is dropped."""
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
                priority=zenoh.Priority.DATA_LOW,  # below reports
            )
        except zenoh.ZError as error:
            _logger.debug("dropped a publication on %s: %s", key, brief(error))

    def subscribe(self, task: str, topics: Sequence[str], capacity: int, deadline: float) -> Subscription:
        """As `Transport.subscribe`."""

        def make(session: zenoh.Session) -> Subscription:
            subscription = Subscription(session, task, topics, capacity)
            self.session.keep(subscription, session)
            return subscription

        return declare(make, f"the subscription to task {task!r}", self.connect, self.session, deadline)

    def announce(self, task: str, worker_id: str, deadline: float) -> Presence:
        """As `Transport.announce`."""
        return Presence.announce(self.connect, self.session, task, worker_id, deadline)

    def take_role(self, task: str, role: str, deadline: float) -> Role | None:
        """As `Transport.take_role`."""
        return Role.take(self.connect, self.session, task, role, deadline)

    def connect(self, deadline: float) -> zenoh.Session:
        """The open session.

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


def _is_empty(error: zenoh.ZError) -> bool:
    """Whether the question ended without a reply."""
    return "empty and closed" in str(error)


def _nobody_serves(session: zenoh.Session, error: zenoh.ZError) -> bool:
    """Whether a router is connected and serves nothing under the key, or denies it to this client."""
    return _is_empty(error) and not session.is_closed() and bool(session.info.routers_zid())


def _pause(attempt: int) -> float:
    """Doubling pauses with jitter, so that many clients do not return at the same moment."""
    return min(_LONGEST_PAUSE_S, _FIRST_PAUSE_S * 2.0 ** min(attempt, 10)) * random.uniform(0.75, 1.25)


def _open_reply(reply: zenoh.Reply, key: str) -> bytes:
    if reply.ok is not None:
        check_encoding(str(reply.ok.encoding))
        return reply.ok.payload.to_bytes()
    if reply.err is None:
        raise _Unanswered("an empty reply")
    body = reply.err.payload.to_bytes()
    if body == b"Timeout":  # Zenoh's own, at the end of the attempt
        raise _Unanswered("connected, but no reply in time", timed_out=True)
    try:
        error = error_from_wire(unpack(body))
    except Invalid as unreadable:
        raise Internal(f"unreadable error reply to {key}: {unreadable.message}") from unreadable
    if isinstance(error, Busy | ShuttingDown):
        pause = None if error.retry_ms is None else min(max(error.retry_ms, 1), 1000) / 1000
        raise _Unanswered(f"{error.code}: {error.message}", pause)
    raise error
