"""One Zenoh session: opened when first needed, closed once, and never used across a fork.

Zenoh connects again by itself after a link was lost. If the time for that is over at the moment when it succeeds, Zenoh
sends on the new connection and never reads from it: every question times out, while the router sees a client that is
alive. A server whose Zenoh panicked may keep a connection alive and not read from it either. So the router is asked
when questions time out. Where it does not answer here and answers in another session, that one takes over.
"""

from __future__ import annotations

import logging
import random
import threading
import time
import weakref
from collections.abc import Callable
from typing import Final, Protocol, TypeVar, final
from weakref import WeakSet

import zenoh

from crkr.client.lifetimes import check_not_forked, hold, is_forked, release
from crkr.client.network.config import Connection, brief
from crkr.client.network.diagnosis import Obstacle, is_deaf, obstacle
from crkr.protocol import CrkrError, Internal, Unavailable
from crkr.protocol.zenoh_files import refusing_panics

__all__ = ["CallsInProgress", "Closable", "Declared", "NotConnected", "Session", "declare"]

_logger = logging.getLogger(__name__)
_OPEN_S: Final = 1.0
_LEAVE_S: Final = 2.0 * _OPEN_S  # Zenoh ends no attempt to open a session before its time
_LOOK_S: Final = 0.5
_LOOK_AGAIN_S: Final = 3.0
_PAUSE_S: Final = 0.2  # between tries to open another session
_ANSWERS_S: Final = 2.0  # the router itself, not the server
_LONGEST_ANSWERS_S: Final = 60.0
_QUIET_S: Final = 300.0  # without a replacement, after which the next one needs no more patience than the first
_AGAIN_S: Final = 0.1  # between tries to declare something

_T = TypeVar("_T")


class NotConnected(Exception):
    """This attempt to open the session failed; another may not."""


class Closable(Protocol):
    """Something to close while the session is still open."""

    def close(self) -> None:
        """Closes it; a second call does nothing."""


class Declared(Protocol):
    """Something declared in the session, as a token or a subscription."""

    def move(self, session: zenoh.Session) -> object:
        """Declares it in the session that takes the place of its own; returns what is to live until that is closed."""


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
        self._finalizer: weakref.finalize[..., Session] | None = None
        self.calls: Final = CallsInProgress()
        self._closed = threading.Event()
        self._closed_before: Final[WeakSet[Closable]] = WeakSet()
        self._declared: WeakSet[Declared] = WeakSet()
        self._checking: threading.Thread | None = None
        self._patience_s, self._replaced = _ANSWERS_S, 0.0  # [s, monotonic]
        self._in_vain = False
        self._end_other: weakref.finalize[..., Session] | None = None  # ends the session that may take over
        self._turn = 0  # the endpoint to try next
        self.obstacle: Obstacle | None = None
        self._look_again = 0.0  # [s, monotonic]
        # Made first, so called last at exit: no thread may be killed while it opens a session.
        weakref.finalize(self, _close, None, self._closed_before, self.calls)

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
            with self.calls:
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
        if self._end_other is not None:
            self._end_other()
        if finalizer is not None:
            finalizer()
            release(self)

    def _connect(self, deadline: float) -> zenoh.Session:
        if self._in_vain:
            self._look(0.5 * (deadline - time.monotonic()))
        patience = min(_OPEN_S, max(0.001, deadline - time.monotonic()))
        turn, self._turn = self._turn, (self._turn + 1) % len(self.connection.endpoints)
        try:
            with refusing_panics():
                session = zenoh.open(self.connection.zenoh(patience, turn))
        except zenoh.ZError as error:
            self._in_vain = True
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
        if self._checking is not None and self._checking.is_alive():
            return
        checking = threading.Thread(
            target=_check, args=(weakref.ref(self), self._closed), name="crkr-suspicion", daemon=True
        )
        try:
            checking.start()
        except RuntimeError as error:  # no more threads
            _logger.debug("the connection to %s is not checked: %s", self.connection.endpoint, error)
        else:
            self._checking = checking

    def check(self) -> bool:
        """Asks the router, and has another session take over where only that one is answered; whether all is well."""
        session = self.peek()
        if session is None:
            return True
        with self.calls:
            if time.monotonic() - self._replaced > _QUIET_S:
                self._patience_s = _ANSWERS_S
            if not is_deaf(session, self._patience_s):
                return True
            fresh = self._connect(time.monotonic() + _OPEN_S)
            self._end_other = end = weakref.finalize(self, _end, fresh)  # at exit it ends the question
            try:
                # Closing waits for this thread, but may have come before `end`.
                return not self.calls.shut and not is_deaf(fresh, _ANSWERS_S) and self._replace(session, fresh, end)
            finally:
                end()

    def _replace(self, session: zenoh.Session, fresh: zenoh.Session, end: weakref.finalize[..., Session]) -> bool:
        """Moves everything to the other session; False if this one was closed or replaced meanwhile."""
        with self._lock:
            if self.peek() is not session or end.detach() is None:
                return False
            _logger.info("the connection to %s is not read from: another session takes over", self.connection.endpoint)
            # A question that a long message holds up looks the same: each time it may take longer.
            self._replaced, self._patience_s = time.monotonic(), min(2.0 * self._patience_s, _LONGEST_ANSWERS_S)
            finalizer = self._finalizer
            self._adopt(fresh)
            former = [_moved(one, fresh) for one in list(self._declared)]
        try:
            is_deaf(fresh, _ANSWERS_S)  # once it is answered, the server knows of all that was declared before
        finally:
            if finalizer is not None and finalizer.detach() is not None:
                _end(session)
            del former
        return True

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


def declare(
    make: Callable[[zenoh.Session], _T],
    what: str,
    connect: Callable[[float], zenoh.Session],
    owner: Session,
    deadline: float,
) -> _T:
    """Declares something, again in the session that takes over, or where the router does not answer.

    Args:
        make: Declares it in a session; returns None where another try may succeed.
        what: For messages, as "the role 'judge'".
        connect: Gives the open session by a deadline.
        owner: Of that session.
        deadline: When to give up, and to return the last None [s, monotonic clock].

    Raises:
        Unavailable: No connection by the deadline.
        Internal: Zenoh refuses.
    """
    while True:
        session, failure = connect(deadline), ""
        try:
            with owner.calls:
                made = make(session)
            if made is not None or time.monotonic() > deadline:
                return made
        except NotConnected as error:
            owner.suspect()
            failure = str(error)
        except zenoh.ZError as error:
            if not session.is_closed():
                raise Internal(f"{what} could not be declared: {brief(error)}") from error
            failure = "the session was closed"
        if failure and time.monotonic() > deadline:
            raise Unavailable(f"{failure} at {owner.connection.endpoint}; is the server running?")
        owner.pause(_AGAIN_S * random.uniform(0.2, 1.0))


def _check(owner: weakref.ref[Session], closed: threading.Event) -> None:
    """Has the connection checked until it is well; keeps no client alive meanwhile."""
    while not closed.is_set() and (session := owner()) is not None:
        try:
            if session.check():
                return
        except BaseException as error:  # a panic in the binding is a BaseException
            _logger.debug("the connection to %s is not read from: %s", session.connection.endpoint, error)
        del session
        closed.wait(_PAUSE_S)


def _moved(one: Declared, session: zenoh.Session) -> object:
    try:
        return one.move(session)
    except BaseException as error:  # the others are to move all the same
        _logger.warning("not declared again: %s", brief(error))
        return None


def _close(session: zenoh.Session | None, earlier: WeakSet[Closable], calls: CallsInProgress) -> None:
    if is_forked():
        return
    for one in list(earlier):
        try:
            one.close()
        except CrkrError as error:
            _logger.warning("before closing the session: %s", error.message)
    calls.shut = True
    if session is not None:
        _end(session)
    calls.wait_until_left()


def _end(session: zenoh.Session) -> None:
    if is_forked():
        return
    try:
        session.close()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
    except zenoh.ZError as error:
        _logger.warning("closing the session: %s", brief(error))
