"""A process that this one starts by `multiprocessing`: the pipe to it, its signals, and its end with its parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, Final, final

from crkr.protocol import pack, unpack

__all__ = ["ORPHANED", "MessagePipe", "PipeClosed", "ctrl_c_blocked", "end_with_parent"]

ORPHANED: Final = 3
"""Exit status of a process whose parent is gone."""


class PipeClosed(Exception):
    """The process at the other end is gone."""


@final
class MessagePipe:
    """One end of a pipe between the supervisor and one of its processes; messages are small maps."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection

    def send(self, message: Mapping[str, Any]) -> None:
        """Sends a message; raises `PipeClosed`."""
        try:
            self.connection.send_bytes(pack(message))
        except (BrokenPipeError, ConnectionResetError, OSError) as error:
            raise PipeClosed(str(error)) from error

    def receive(self, timeout_s: float) -> dict[str, Any] | None:
        """The next message, or None if none came in time; raises `PipeClosed`."""
        try:
            return unpack(self.connection.recv_bytes()) if self.connection.poll(timeout_s) else None
        except (EOFError, BrokenPipeError, ConnectionResetError, OSError) as error:
            raise PipeClosed(str(error)) from error

    def close(self) -> None:
        """Closes this end, which the other side sees."""
        self.connection.close()


@contextmanager
def ctrl_c_blocked() -> Iterator[None]:
    """A process started in this context never sees SIGINT or SIGHUP; ours are delivered afterwards.

    A terminal sends both to every process of a command. The parent ends its own in order.
    """
    resource_tracker.ensure_running()  # starting it would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """Ends this process when its parent ends, however that happens; no effect in a process without such a parent."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(ORPHANED)  # the main thread may be deep in a call; what was reported is stored

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
