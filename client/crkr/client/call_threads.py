"""Threads for blocking calls, and blocking calls awaited in an event loop.

The threads are daemons: those of `concurrent.futures` keep a process from ending while a call is in progress.
"""

from __future__ import annotations

import asyncio
import functools
import sys
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, TypeVar, final

from crkr.client.checks import positive
from crkr.client.lifetimes import check_not_forked
from crkr.protocol import Invalid, Unavailable

if sys.version_info >= (3, 11):
    from asyncio import timeout_at
else:
    from async_timeout import timeout_at

__all__ = ["TIMED_OUT", "AwaitedCalls", "CallThreads", "run_aside", "timeout_at"]

TIMED_OUT = (TimeoutError, asyncio.TimeoutError)  # one and the same from Python 3.11 on

_T = TypeVar("_T")


@final
class CallThreads:
    """Runs each call at once, on an idle thread or on a new one.

    Args:
        name: What the threads' names begin with.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._work: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._lock = threading.Lock()
        self._count = self._free = 0  # threads, and idle threads

    def submit(self, call: Callable[[], _T]) -> Future[_T]:
        """Starts a call; must not be used after `close`."""
        future: Future[_T] = Future()
        with self._lock:
            if self._free:
                self._free -= 1
            else:
                threading.Thread(target=self._run, name=f"{self._name}-{self._count + 1}", daemon=True).start()
                self._count += 1  # not where the system gives no thread
        self._work.put((future, call))
        return future

    @property
    def busy(self) -> int:
        """How many calls are in progress."""
        return self._count - self._free

    def close(self) -> None:
        """Lets each thread end when its call has ended."""
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
        except BaseException as error:  # the future tells it
            self._rest()
            future.set_exception(error)
            del future, call  # the error's traceback holds this frame, and the future the error
        else:
            self._rest()  # before the result is known, since its receiver may submit the next call
            future.set_result(result)

    def _rest(self) -> None:
        with self._lock:
            self._free += 1


@final
class AwaitedCalls:
    """Awaits blocking calls on threads, at most `most` at a time; the time that a call waits for a free slot counts."""

    def __init__(self, most: int, timeout_s: float) -> None:
        if not isinstance(most, int) or isinstance(most, bool) or most < 1:
            raise Invalid(f"in_flight must be a whole number of calls, at least 1; got {most!r}")
        self.most, self.timeout_s = most, timeout_s
        self.closed = False
        self._threads = CallThreads("crkr-async")
        # A semaphore belongs to one event loop; a program may run several, one after another.
        self._slots: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Semaphore] = (
            weakref.WeakKeyDictionary()
        )
        self._end = weakref.finalize(self, self._threads.close)

    async def run(self, call: Callable[..., _T], *args: Any, timeout_s: float | None = None, **kwargs: Any) -> _T:
        """Returns the call's result; passes it the remaining time."""
        check_not_forked()
        loop = asyncio.get_running_loop()
        deadline = loop.time() + (self.timeout_s if timeout_s is None else positive(timeout_s))
        slots = self._slots_in(loop)
        try:
            async with timeout_at(deadline):
                await slots.acquire()
        except TIMED_OUT as error:
            raise Unavailable(
                f"{self.most} calls were in progress until the deadline; raise in_flight or timeout_s, "
                "or ask for many states in one call"
            ) from error
        if self.closed:
            slots.release()
            raise Unavailable(f"the client is closed: {call.__qualname__} was not called")
        left = max(deadline - loop.time(), 0.001)
        try:
            future = self._threads.submit(functools.partial(call, *args, **kwargs, timeout_s=left))
        except BaseException:  # the system has no thread left
            slots.release()
            raise
        try:
            return await asyncio.wrap_future(future)
        finally:
            if future.done():
                slots.release()
            else:  # cancelled; the thread still runs
                future.add_done_callback(functools.partial(_release, loop, slots))

    @property
    def in_progress(self) -> int:
        """How many calls are on a thread, cancelled ones too."""
        return self._threads.busy

    def _slots_in(self, loop: asyncio.AbstractEventLoop) -> asyncio.Semaphore:
        if (slots := self._slots.get(loop)) is None:
            for over in [one for one in self._slots if one.is_closed()]:  # a semaphore keeps its loop alive
                del self._slots[over]
            slots = self._slots[loop] = asyncio.Semaphore(self.most)
        return slots

    def close(self) -> None:
        """Takes no more calls."""
        self.closed = True
        self._end()


async def run_aside(call: Callable[[], None]) -> None:
    """Calls it on a thread of its own; the loop's executor may be full of calls that end only with it."""
    threads = CallThreads("crkr-async-close")
    future = threads.submit(call)
    threads.close()
    await asyncio.wrap_future(future)


def _release(loop: asyncio.AbstractEventLoop, slots: asyncio.Semaphore, _: Future[Any]) -> None:
    with suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(slots.release)
