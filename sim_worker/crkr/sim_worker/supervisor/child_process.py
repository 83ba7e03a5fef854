"""A process that this one starts by `multiprocessing`: the pipe to it, its signals, and its end with its parent."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final, final

from crkr.protocol import CrkrError, pack, unpack

__all__ = ["ORPHANED", "MessagePipe", "PipeClosed", "ctrl_c_blocked", "descendants_ended", "end_with_parent"]

ORPHANED: Final = 3
"""Exit status of a process whose parent is gone."""

_PARENT_DEATH_SIGNAL: Final = 1  # of Linux's prctl
_CHILD_SUBREAPER: Final = 36
_ENDING_S: Final = 3.0
_WHOLE_WITHIN_S: Final = 2
_LARGEST: Final = 2**20


class PipeClosed(Exception):
    """The process at the other end is gone."""


@final
class MessagePipe:
    """One end of a pipe between the supervisor and one of its processes; messages are small maps.

    A skill may write to it too: what is no message, or does not end within two seconds, closes the pipe.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        with socket.socket(fileno=os.dup(connection.fileno())) as pipe:
            pipe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", _WHOLE_WITHIN_S, 0))

    def send(self, message: Mapping[str, Any]) -> None:
        """Sends a message; raises `PipeClosed`."""
        try:
            self.connection.send_bytes(pack(message))
        except (BrokenPipeError, ConnectionResetError, OSError) as error:
            raise PipeClosed(str(error)) from error

    def receive(self, timeout_s: float) -> dict[str, Any] | None:
        """The next message, or None if none came in time; raises `PipeClosed`."""
        try:
            return unpack(self.connection.recv_bytes(_LARGEST)) if self.connection.poll(timeout_s) else None
        except (EOFError, OSError, CrkrError) as error:
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


@contextmanager
def descendants_ended() -> Iterator[None]:
    """Kills, on leaving, what processes started in this context started themselves and left behind; Linux only.

    Other threads start no processes meanwhile: they would be killed too.
    """
    resource_tracker.ensure_running()
    own, spared = os.getpid(), _children(os.getpid())
    _prctl(_CHILD_SUBREAPER, 1)  # what they leave behind becomes a child of this process
    try:
        yield
    finally:
        deadline = time.monotonic() + _ENDING_S
        while (left := _children(own) - spared) and time.monotonic() < deadline:
            for each in left.union(*map(_children, left)):
                with suppress(OSError):
                    os.kill(each, signal.SIGKILL)
            for each in left:
                with suppress(OSError):
                    os.waitpid(each, os.WNOHANG)
            time.sleep(0.01)
        _prctl(_CHILD_SUBREAPER, 0)


def _children(pid: int) -> set[int]:
    """A process's children; empty where the kernel does not list them."""
    found = set[int]()
    for listed in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the thread has ended
            found |= {int(child) for child in listed.read_bytes().split()}
    return found


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value)


def end_with_parent() -> None:
    """Ends this process when its parent ends, however that happens; no effect in a process without such a parent."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    _prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)  # also in a call that never lets other threads run

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(ORPHANED)  # the main thread may be deep in a call; what was reported is stored

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
