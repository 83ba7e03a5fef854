"""One Zenoh session: opened when first needed, closed once, and never used across a fork.

Zenoh connects again by itself after a link was lost. If the time for that is over at the moment when it succeeds, Zenoh
sends on the new connection and never reads from it: every question times out, while the router sees a client that is
alive. A server whose Zenoh panicked may keep a connection alive and not read from it either. So the router is asked
when questions time out, and where it does not answer, another session takes the place of this one.
"""

from __future__ import annotations

import logging
import threading
import time
import weakref
from typing import Final, Protocol, final
from weakref import WeakSet

import zenoh

from crkr.client.lifetimes import check_not_forked, hold, is_forked, release
from crkr.client.network.config import Connection, brief
from crkr.client.network.diagnosis import Obstacle, is_deaf, obstacle
from crkr.protocol import CrkrError, Unavailable
from crkr.protocol.zenoh_files import refusing_panics

__all__ = ["CallsInProgress", "Closable", "Declared", "NotConnected", "Session"]

_logger = logging.getLogger(__name__)
_OPEN_S: Final = 1.0
_LEAVE_S: Final = 1.0
_LOOK_S: Final = 0.5
_LOOK_AGAIN_S: Final = 3.0
_PAUSE_S: Final = 0.2  # between tries to open another session
_ANSWERS_S: Final = 2.0  # the router itself, not the server


class NotConnected(Exception):
    """This attempt to open the session failed; another may not."""


class Closable(Protocol):
    """Something to close while the session is still open."""

    def close(self) -> None:
        """Closes it; a second call does nothing."""


class Declared(Protocol):
    """Something declared in the session, as a token or a subscription."""

    def move(self, session: zenoh.Session) -> None:
        """Declares it in the session that takes the place of its own, which is closed after that."""


@final
class CallsInProgress:
    """Threads inside a Zenoh call.

    Interpreter exit kills daemon threads, which aborts the process in Zenoh's Rust code, so closing waits for them.
    """

    __slots__ = ("_threads", "shut")

    def __init__(self) -> None:
        self._threads: dict[int, None] = {}
        self.shut = False

    def __enter__(self) -> None:
        self._threads[threading.get_ident()] = None
        if self.shut:  # checked after the thread is registered, so that closing cannot overlook it
            del self._threads[threading.get_ident()]
            raise NotConnected("the session was closed")

    def __exit__(self, *error: object) -> None:
        del self._threads[threading.get_ident()]

    def wait_until_left(self) -> None:
        """Waits for the other threads, whose calls end as soon as the session is closed."""
        until, me, pause = time.monotonic() + _LEAVE_S, threading.get_ident(), threading.Event()
        while any(thread != me for thread in list(self._threads)) and time.monotonic() < until:
            pause.wait(0.001)


@final
class Session:
    """Opens at the first use, so that a client may be made before its server runs.

    After a broken connection everything is declared again, by Zenoh or in the session that takes its place. `close`,
    garbage collection or the interpreter's exit (before its threads end) closes the session, whichever comes first.

    Attributes:
        connection: Endpoint and configuration.
        calls: Entered for each Zenoh call that blocks.
        obstacle: What kept the last attempt from connecting.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection: Final = connection
        self._lock = threading.RLock()  # if an interrupt leaves it held, its thread can still take it
        self._session: zenoh.Session | None = None
        self._finalizer: weakref.finalize[[zenoh.Session, WeakSet[Closable], CallsInProgress], Session] | None = None
        self.calls: Final = CallsInProgress()
        self._closed = threading.Event()
        self._closed_before: WeakSet[Closable] = WeakSet()
        self._declared: WeakSet[Declared] = WeakSet()
        self._checking: threading.Thread | None = None
        self._in_vain = False
        self._turn = 0  # the endpoint to try first
        self.obstacle: Obstacle | None = None
        self._look_again = 0.0  # [s, monotonic]

    def open(self, deadline: float) -> zenoh.Session:
        """The open session.

        Raises:
            NotConnected: No router answers at the endpoint yet.
            Unavailable: The client was closed, belongs to another process, or does not agree with the server about
                certificates.
        """
        self._check()
        session = self._session
        if session is not None:
            return session
        if not self._lock.acquire(timeout=max(0.0, deadline - time.monotonic())):
            raise NotConnected("another thread is still connecting")
        try:
            self._check()
            return self._session or self._adopt(self._connect(deadline))
        finally:
            self._lock.release()

    def peek(self) -> zenoh.Session | None:
        """The session if it is open."""
        return None if self._closed.is_set() or is_forked() else self._session

    def close_before(self, one: Closable) -> None:
        """Closes an object before the session ends in any way; keeps only a weak reference."""
        self._closed_before.add(one)

    def keep(self, one: Declared, session: zenoh.Session) -> None:
        """Moves what was declared in a session to the one that takes its place; keeps only a weak reference."""
        with self._lock:
            self._declared.add(one)
            if self._session is not None and self._session is not session:  # it was replaced meanwhile
                one.move(self._session)

    def pause(self, seconds: float) -> None:
        """Waits; closing the session ends the wait."""
        self._closed.wait(seconds)

    def close(self) -> None:
        """Closes the session; calls in progress end, later ones raise `Unavailable`."""
        self._closed.set()
        if is_forked():
            return
        with self._lock:
            finalizer, self._finalizer, self._session = self._finalizer, None, None
        if finalizer is not None:
            finalizer()
            release(self)

    def _connect(self, deadline: float) -> zenoh.Session:
        if self._in_vain:
            self._look(0.5 * (deadline - time.monotonic()))
        patience = min(_OPEN_S, max(0.001, deadline - time.monotonic()))
        try:
            with refusing_panics():
                session = zenoh.open(self.connection.zenoh(patience, self._turn))
        except zenoh.ZError as error:
            self._in_vain = True
            self._turn = (self._turn + 1) % len(self.connection.endpoints)
            raise NotConnected(f"cannot connect: {brief(error)}") from error
        _logger.debug("connected to %s", self.connection.endpoint)
        return session

    def _adopt(self, session: zenoh.Session) -> zenoh.Session:
        self.obstacle = None
        self._session = session
        self._finalizer = weakref.finalize(self, _close, session, self._closed_before, self.calls)
        hold(self, session)
        return session

    def suspect(self) -> None:
        """Has the connection checked, by a thread of its own, unless one is about it."""
        checking = self._checking
        if checking is None or not checking.is_alive():
            self._checking = threading.Thread(target=self._check_connection, name="crkr-suspicion", daemon=True)
            try:
                self._checking.start()
            except RuntimeError as error:  # no more threads
                _logger.debug("the connection to %s is not checked: %s", self.connection.endpoint, error)

    def _check_connection(self) -> None:
        """Has another session take the place of one whose router does not answer, however long that takes."""
        session = self.peek()
        while session is not None and session is self.peek():
            try:
                with self.calls:
                    if not is_deaf(session, _ANSWERS_S):
                        return
                    self._replace(session)
            except BaseException as error:  # a panic in the binding is a BaseException
                _logger.debug("the connection to %s is not read from: %s", self.connection.endpoint, error)
                self.pause(_PAUSE_S)

    def _replace(self, session: zenoh.Session) -> None:
        with self._lock:
            if self.peek() is not session:
                return
            fresh = self._connect(time.monotonic() + _OPEN_S)
            _logger.info("the connection to %s is not read from: another session takes over", self.connection.endpoint)
            finalizer = self._finalizer
            self._adopt(fresh)
            for one in list(self._declared):
                try:
                    one.move(fresh)
                except zenoh.ZError as error:
                    _logger.warning("not declared again: %s", brief(error))
        if finalizer is not None and finalizer.detach() is not None:
            session.close()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type

    def _look(self, patience_s: float) -> None:
        """Raises `Unavailable` where another attempt cannot help; Zenoh would try until the deadline."""
        now = time.monotonic()
        if patience_s <= 0.0 or now < self._look_again:
            return
        if not self.connection.endpoints[0].startswith("tls/"):  # only TLS errors are final
            self._look_again = now + _LOOK_AGAIN_S
        connection = self.connection
        self.obstacle = obstacle(connection.endpoint, connection.zenoh(1.0), min(_LOOK_S, patience_s))
        if self.obstacle is not None and self.obstacle.final:
            endpoint, found = connection.endpoint, self.obstacle.what
            raise Unavailable(f"no connection to {endpoint}: {found}", details={"endpoint": endpoint, "refusal": found})

    def _check(self) -> None:
        if self._closed.is_set():
            raise Unavailable(f"the client of {self.connection.endpoint} is closed")
        check_not_forked()


def _close(session: zenoh.Session, earlier: WeakSet[Closable], calls: CallsInProgress) -> None:
    if is_forked():
        return
    for one in list(earlier):
        try:
            one.close()
        except CrkrError as error:
            _logger.warning("before closing the session: %s", error.message)
    calls.shut = True
    try:
        session.close()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
    except zenoh.ZError as error:
        _logger.warning("closing the session: %s", brief(error))
    calls.wait_until_left()
