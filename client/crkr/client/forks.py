"""What a fork would break: Zenoh's threads stay in the parent, so in the child its objects can only be left alone.

To open a session there, to call through one, or merely to free one waits forever. So the child is refused with a clear
error, and keeps what it inherited until it ends.
"""

from __future__ import annotations

import ctypes
import os
from typing import Final
from weakref import WeakKeyDictionary

from crkr.protocol import Unavailable

__all__ = ["check_not_forked", "hold", "is_forked", "release"]

_held: Final[WeakKeyDictionary[object, object]] = WeakKeyDictionary()


class _Process:
    """What this process knows of itself."""

    used_zenoh = False
    inherited_zenoh = False


def hold(owner: object, resource: object) -> None:
    """Notes that `owner` has a Zenoh object, until `release` or the owner's end."""
    _Process.used_zenoh = True
    _held[owner] = resource


def release(owner: object) -> None:
    """Forgets what `owner` had."""
    _held.pop(owner, None)


def is_forked() -> bool:
    """Whether this process was forked from one that had used Zenoh."""
    return _Process.inherited_zenoh


def check_not_forked() -> None:
    """Raises `Unavailable` where `is_forked`."""
    if is_forked():
        raise Unavailable(
            "this process was forked from one that had a client, and Zenoh cannot cross a fork; "
            "start processes with multiprocessing's 'spawn' method, or fork before the first call"
        )


def _in_child() -> None:
    _Process.inherited_zenoh = _Process.inherited_zenoh or _Process.used_zenoh
    for resource in list(_held.values()):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(resource))  # never freed, on purpose


os.register_at_fork(after_in_child=_in_child)
