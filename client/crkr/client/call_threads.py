"""Threads for calls that wait: daemons, since an executor's threads keep a process that forgot to close it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, TypeVar, final

__all__ = ["Daemons"]

_T = TypeVar("_T")


@final
class Daemons:
    """Runs calls, each at once, on a thread that has finished another or on a new one.

    Args:
        name: What the threads' names begin with.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._work: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._lock = threading.Lock()
        self._count = self._free = 0  # threads, and those of them that nobody has work for

    def submit(self, call: Callable[[], _T]) -> Future[_T]:
        """What the call will return; not after `close`."""
        future: Future[_T] = Future()
        with self._lock:
            if self._free:
                self._free -= 1
            else:
                threading.Thread(target=self._run, name=f"{self._name}-{self._count + 1}", daemon=True).start()
                self._count += 1  # not where the system gives no thread
        self._work.put((future, call))
        return future

    def close(self) -> None:
        """Ends the threads as they finish."""
        with self._lock:
            for _ in range(self._count):
                self._work.put(None)
            self._count = 0

    def _run(self) -> None:
        while (work := self._work.get()) is not None:
            self._do(*work)
            del work  # or it would live until the next one, and a forgotten client with it

    def _do(self, future: Future[Any], call: Callable[[], Any]) -> None:
        if not future.set_running_or_notify_cancel():
            self._rest()
            return
        try:
            result = call()
        except BaseException as error:  # told to whoever waits
            self._rest()
            future.set_exception(error)
            del future, call  # the error's traceback holds this frame, and the future the error
        else:
            self._rest()  # before anybody hears of the result and brings the next call
            future.set_result(result)

    def _rest(self) -> None:
        with self._lock:
            self._free += 1
