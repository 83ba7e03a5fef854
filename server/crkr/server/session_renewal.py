"""Renewal of the Zenoh session where Zenoh has broken it.

A message that Zenoh cannot pack, such as a publication under an overlong key, makes it panic while it holds the queue
of each subscriber's connection. From then on every send to those clients panics, and they hear no answer any more,
although their connections stand. Zenoh neither says which those are nor closes one, so the whole session is opened
anew: clients connect again by themselves within a second. It is done at most twice a minute, as a client can cause it.
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

from crkr.server.thread_faults import keep_running

__all__ = ["SessionRenewal", "cut_connections"]

_AGAIN_S: Final = 0.3  # a second panic, so long after the first or later, says that it does not pass by itself
_WITHIN_S: Final = 10.0
_PAUSE_S: Final = 30.0  # between renewals
_PORT: Final = re.compile(r":(\d+)(?:[?#]|$)")  # of an endpoint


@final
class SessionRenewal:
    """A thread that calls `renew` once panics go on.

    Args:
        renew: Opens the session anew.
    """

    def __init__(self, renew: Callable[[], None]) -> None:
        self._renew = renew
        self._lock, self._wanted = threading.Lock(), threading.Event()
        self._first = self._last = float("-inf")
        self._stopped = False
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name="session renewal", daemon=True)

    def start(self) -> None:
        """Begins to heed panics."""
        self._thread.start()

    def heed(self) -> None:
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
        self._wanted.wait()
        self._wanted.clear()
        if not self._stopped:
            self._renew()
        return not self._stopped


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
