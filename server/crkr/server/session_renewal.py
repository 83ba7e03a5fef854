"""Renewal of the Zenoh session where Zenoh has broken it.

A message that Zenoh cannot pack, such as a publication under an overlong key, makes it panic while it holds the queue
of each subscriber's connection. From then on every send to those clients panics, and they hear no answer any more,
although their connections stand. A declaration whose key is no key expression makes it panic while it holds its own
tables, and nobody is answered any more. Zenoh neither mends that nor ends by it, so the whole session is opened anew:
clients connect again by themselves within a second.
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
from crkr.server.thread_faults import is_panic, keep_running

__all__ = ["SessionRenewal", "cut_connections", "is_broken"]

_AGAIN_S: Final = 0.3  # a second panic, so long after the first or later, says that it does not pass by itself
_WITHIN_S: Final = 10.0
_PAUSE_S: Final = 30.0  # between renewals for such panics, which a client can cause
_PROBE_S: Final = 2.0  # between looks at the session
_PORT: Final = re.compile(r":(\d+)(?:[?#]|$)")  # of an endpoint


@final
class SessionRenewal:
    """A thread that calls `renew` once panics go on, or the session is found broken.

    Args:
        renew: Opens the session anew.
        is_broken: Whether the session there is now answers nobody.
        give_up: Ends the process, as a new session was broken from the start.
    """

    def __init__(self, renew: Callable[[], None], is_broken: Callable[[], bool], give_up: Callable[[], None]) -> None:
        self._renew, self._is_broken, self._give_up = renew, is_broken, give_up
        self._lock, self._wanted = threading.Lock(), threading.Event()
        self._first = self._last = float("-inf")
        self._stopped = False
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name="session renewal", daemon=True)

    def start(self) -> None:
        """Begins to heed panics."""
        self._thread.start()

    def note_panic(self) -> None:
        """Notes a panic; any thread may."""
        now = time.monotonic()
        with self._lock:
            if now - self._last < _PAUSE_S:
                return
            if now - self._first > _WITHIN_S:
                self._first = now
            elif now - self._first >= _AGAIN_S:
                self._first, self._last = float("-inf"), now
                self._wanted.set()

    def stop(self, patience_s: float) -> None:
        """Renews no more."""
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
            except BaseException:
                self._give_up()
                raise
            if broken:
                self._give_up()
        return not self._stopped


def is_broken(session: zenoh.Session) -> bool:
    """Whether Zenoh panics over a query and a token of the session's own; nothing else is proof."""
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
    """Cuts the process's TCP connections that came to these endpoints; does nothing where there is no /proc.

    A broken session does not end its connections as it closes, and their clients would wait for it for ever.
    """
    ports = {int(found[1]) for endpoint in endpoints if (found := _PORT.search(endpoint))}
    with suppress(OSError):
        for entry in Path("/proc/self/fd").iterdir():
            # Only sockets: to close a copy of a database's file would end SQLite's locks on it.
            with suppress(OSError, ValueError):
                if os.readlink(entry).startswith("socket:"):
                    with socket.socket(fileno=os.dup(int(entry.name))) as connection:
                        if connection.family != socket.AF_UNIX and connection.getsockname()[1] in ports:
                            connection.getpeername()  # raises for the one that listens
                            connection.shutdown(socket.SHUT_RDWR)
