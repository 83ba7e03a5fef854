"""Renewal of a Zenoh session that a client has broken.

A message that Zenoh cannot encode, such as a publication with an overlong key, makes it panic while it locks the send
queues of the subscribers. Every later send to those clients panics, although they are still connected. A declaration
whose key is not a key expression makes Zenoh panic while it locks its routing tables, and no client gets an answer any
more. Zenoh does not recover, so the session is opened again; clients reconnect within a second.

A client that sends such a message to each new session must not end the service, however often it does: renewal goes on
for as long as a session that no client can reach works. Where that one is broken too, or the port cannot be listened
on, only a new process helps.
"""

from __future__ import annotations

import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final, final
from uuid import uuid4

import zenoh

from crkr.protocol import live_server_key
from crkr.protocol.zenoh_files import is_panic
from crkr.server.session import open_private_session
from crkr.server.thread_faults import FAULTS, keep_running

__all__ = ["SessionRenewal", "cut_connections", "is_broken", "works_alone"]

_POISONED: Final = "PoisonError"
_AGAIN_S: Final = 0.3  # a second panic after this time shows that the fault persists
_WITHIN_S: Final = 10.0
_PAUSE_S: Final = 30.0  # between renewals for such panics
_PROBE_S: Final = 2.0  # between probes of the session
_MOST_FAILURES: Final = 5  # renewals in a row before the process may be given up
_FIRST_PAUSE_S: Final = 0.2  # after a renewal that failed; twice as long after each further one
_LONGEST_PAUSE_S: Final = 2.0  # nobody is answered meanwhile
_PORT: Final = re.compile(r":(\d+)(?:[?#]|$)")  # of an endpoint


@final
class SessionRenewal:
    """A thread that calls `renew` when panics persist, or a probe finds the session broken.

    Args:
        renew: Closes the session, whatever is left of it, and opens another.
        is_broken: Whether the present session is broken.
        give_up: Called when renewal keeps failing, and not by what clients send.
        works: Whether Zenoh works in this process where no client interferes.
    """

    def __init__(
        self,
        renew: Callable[[], None],
        is_broken: Callable[[], bool],
        give_up: Callable[[], None],
        works: Callable[[], bool],
    ) -> None:
        self._renew, self._is_broken, self._give_up, self._works = renew, is_broken, give_up, works
        self._lock, self._wanted = threading.Lock(), threading.Event()
        self._first = self._last = float("-inf")
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name="session renewal", daemon=True)

    def start(self) -> None:
        """Start to watch."""
        self._thread.start()

    def note_panic(self, panic: BaseException) -> None:
        """Record a panic; thread-safe. One over a lock that an earlier panic left poisoned is of a fault that stays."""
        now = time.monotonic()
        with self._lock:
            if now - self._last < _PAUSE_S:
                return
            lasting = _POISONED in str(panic)
            if now - self._first > _WITHIN_S and not lasting:
                self._first = now
            elif now - self._first >= _AGAIN_S or lasting:
                self._first, self._last = float("-inf"), now
                self._wanted.set()

    def stop(self, patience_s: float) -> None:
        """Stop renewing."""
        self._stopped.set()
        self._wanted.set()
        if self._thread.is_alive():
            self._thread.join(patience_s)

    def _step(self) -> bool:
        wanted = self._wanted.wait(_PROBE_S)
        self._wanted.clear()
        if not self._stopped.is_set() and (wanted or self._is_broken()):
            self._renew_until_it_works()
        return not self._stopped.is_set()

    def _renew_until_it_works(self) -> None:
        failures, pause_s = 0, _FIRST_PAUSE_S
        while not self._stopped.is_set():
            try:
                self._renew()
                if not self._is_broken():
                    return
                panicked = True
            except BaseException as error:
                FAULTS.note(error)
                panicked = is_panic(error) or (error.__cause__ is not None and is_panic(error.__cause__))
            failures += 1
            if failures >= _MOST_FAILURES:
                # Clients make Zenoh panic; they cannot take the port away, or the memory for another thread.
                if not (panicked and self._works()):
                    if not self._stopped.is_set():
                        self._give_up()
                    return
                failures = 0
            self._stopped.wait(pause_s)
            pause_s = min(_LONGEST_PAUSE_S, 2 * pause_s)


def is_broken(session: zenoh.Session) -> bool:
    """Whether Zenoh panics over a query or a token of this session; only a panic is proof."""
    key = live_server_key(f"probe/{uuid4()}")
    try:
        session.get(key, zenoh.handlers.FifoChannel(1), timeout=_PROBE_S)
        session.liveliness().declare_token(key).undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the type
    except zenoh.ZError:  # it is closed
        return False
    except BaseException as error:
        if is_panic(error):
            return True
        raise
    return False


def works_alone() -> bool:
    """Whether a session that no client can reach works in this process."""
    try:
        with open_private_session() as session:
            return not is_broken(session)
    except BaseException as error:
        FAULTS.note(error)
        return False


def cut_connections(endpoints: Iterable[str]) -> None:
    """Cut the process's TCP connections at these endpoints; does nothing without /proc.

    A broken session leaves its connections open as it closes, and their clients would wait forever.
    """
    ports = {int(found[1]) for endpoint in endpoints if (found := _PORT.search(endpoint))}
    with suppress(OSError):
        for entry in Path("/proc/self/fd").iterdir():
            # Only sockets: closing a copy of a database's file would release SQLite's locks.
            with suppress(OSError, ValueError):
                if os.readlink(entry).startswith("socket:"):
                    with socket.socket(fileno=os.dup(int(entry.name))) as connection:
                        if connection.family != socket.AF_UNIX and connection.getsockname()[1] in ports:
                            connection.getpeername()  # raises for the listening socket
                            connection.shutdown(socket.SHUT_RDWR)
