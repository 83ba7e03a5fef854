"""Renewal of a Zenoh session that a client has broken.

A message that Zenoh cannot encode, such as a publication with an overlong key, makes it panic while it locks the send
queues of the subscribers. Every later send to those clients panics, although they are still connected. A declaration
whose key is not a key expression makes Zenoh panic while it locks its routing tables, and no client gets an answer any
more. Zenoh does not recover, so the session is opened again; clients reconnect within a second.
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
from crkr.server.thread_faults import FAULTS, keep_running

__all__ = ["SessionRenewal", "cut_connections", "is_broken"]

_POISONED: Final = "PoisonError"
_AGAIN_S: Final = 0.3  # a second panic after this time shows that the fault persists
_WITHIN_S: Final = 10.0
_PAUSE_S: Final = 30.0  # between renewals for such panics
_PROBE_S: Final = 2.0  # between probes of the session
_PORT: Final = re.compile(r":(\d+)(?:[?#]|$)")  # of an endpoint


@final
class SessionRenewal:
    """A thread that calls `renew` when panics persist, or a probe finds the session broken."""

    def __init__(self, renew: Callable[[], None], is_broken: Callable[[], bool], give_up: Callable[[], None]) -> None:
        self._renew, self._is_broken, self._give_up = renew, is_broken, give_up
        self._lock, self._wanted = threading.Lock(), threading.Event()
        self._first = self._last = float("-inf")
        self._stopped = False
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
        self._stopped = True
        self._wanted.set()
        self._thread.join(patience_s)

    def _step(self) -> bool:
        wanted = self._wanted.wait(_PROBE_S)
        self._wanted.clear()
        if not self._stopped and (wanted or self._is_broken()):
            try:
                self._renew()
                broken = self._is_broken()
            except BaseException as error:
                FAULTS.note(error)
                broken = True
            if broken and not self._stopped:
                self._give_up()
        return not self._stopped


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
