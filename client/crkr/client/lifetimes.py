"""How objects end: at the end of a `with` block, and in a forked child, where they must be left alone.

Zenoh's threads stay in the parent. In the child, opening a session, using one or freeing one waits forever, and closing
an SQLite database loses the parent's latest entries. So calls in the child raise `Unavailable`, and the child keeps
what it inherited until it ends.
"""

from __future__ import annotations

import ctypes
import os
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Final
from weakref import WeakKeyDictionary

from crkr.protocol import Unavailable
from crkr.protocol.earlier_python import Self

__all__ = ["AsyncClosing", "Closing", "check_not_forked", "hold", "is_forked", "leave_in_child", "release", "stay"]

_held: Final[WeakKeyDictionary[object, object]] = WeakKeyDictionary()
_locked: Final[set[int]] = set()  # open files


class Closing(ABC):
    """Something to be closed, which the end of a `with` block does."""

    __slots__ = ("__weakref__",)

    @abstractmethod
    def close(self) -> None:
        """Closes it; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class AsyncClosing(ABC):
    """Something to be closed, which the end of an `async with` block does."""

    __slots__ = ("__weakref__",)

    @abstractmethod
    async def close(self) -> None:
        """Closes it; a second call does nothing."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()


class _Process:
    """State of this process."""

    holds = False
    inherited = False


def hold(owner: object, resource: object) -> None:
    """Registers that `owner` has a resource that cannot cross a fork, until `release` or the owner's end."""
    _Process.holds = True
    _held[owner] = resource


def release(owner: object) -> None:
    """Takes `hold` back."""
    _held.pop(owner, None)


def leave_in_child(file: int) -> None:
    """Has a forked child close an open file, so that a lock on it ends with this process."""
    _locked.add(file)


def stay(file: int) -> None:
    """Takes `leave_in_child` back."""
    _locked.discard(file)


def is_forked() -> bool:
    """Whether this process was forked from one that held such a resource."""
    return _Process.inherited


def check_not_forked() -> None:
    """Raises `Unavailable` where `is_forked`."""
    if is_forked():
        raise Unavailable(
            "this process was forked from one that had a client, which cannot cross a fork; "
            "start processes with multiprocessing's 'spawn' method, or fork before the first call"
        )


def _in_child() -> None:
    for file in _locked:
        with suppress(OSError):
            os.close(file)
    _locked.clear()
    _Process.inherited = _Process.inherited or _Process.holds
    for resource in list(_held.values()):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(resource))  # never freed, on purpose


os.register_at_fork(after_in_child=_in_child)
