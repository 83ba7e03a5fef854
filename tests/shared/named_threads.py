"""Threads of the program under test, found by name."""

import ctypes
import threading


def thread_named(name: str) -> threading.Thread:
    """The one living thread of that name."""
    [found] = [thread for thread in threading.enumerate() if thread.name == name]
    return found


def raise_in(name: str, raised: type[BaseException]) -> None:
    """Raises in the thread of that name, at its next step."""
    identity = thread_named(name).ident
    assert ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(identity or 0), ctypes.py_object(raised)) == 1
