"""The client for programs that live in an event loop: the same calls, awaited.

Each call in progress has a thread of its own underneath. Zenoh has no coroutines, and a bridge from its threads to the
loop carries fewer calls a second than threads that wait do.
"""

from __future__ import annotations

import asyncio
import functools
import weakref
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, Final, ParamSpec, TypeVar, final

from crkr.client.call_threads import Daemons
from crkr.client.client import Client, TaskSummary
from crkr.client.lifetimes import check_not_forked
from crkr.client.network.subscription import TOPICS, Subscription
from crkr.client.rpc import positive
from crkr.client.task import Task
from crkr.protocol import Invalid, StoredTrial, TaskSpec, Unavailable

__all__ = ["AsyncClient", "AsyncSubscription", "AsyncTask"]

_P = ParamSpec("_P")
_T = TypeVar("_T")
_LISTEN_S: Final = 0.5  # a thread that waits for publications looks so often whether it is still wanted


@final
class _Calls:
    """Runs blocking calls on threads, so many at a time; a call that waits for its turn waits within its deadline."""

    def __init__(self, most: int, timeout_s: float) -> None:
        if not isinstance(most, int) or isinstance(most, bool) or most < 1:
            raise Invalid(f"in_flight must be a whole number of calls, at least 1; got {most!r}")
        self.most, self.timeout_s = most, timeout_s
        self.closed = False
        self._daemons = Daemons("crkr-async")
        # A semaphore belongs to the loop that it was first waited for in; a program may run several after each other.
        self._turns: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Semaphore] = (
            weakref.WeakKeyDictionary()
        )
        self._end = weakref.finalize(self, self._daemons.close)

    async def run(self, call: Callable[..., _T], *args: Any, timeout_s: float | None = None, **kwargs: Any) -> _T:
        """What the call returns; it is told the time that is left to it."""
        check_not_forked()
        loop = asyncio.get_running_loop()
        deadline = loop.time() + (self.timeout_s if timeout_s is None else positive(timeout_s))
        turns = self._turns_in(loop)
        try:
            async with asyncio.timeout_at(deadline):
                await turns.acquire()
        except TimeoutError as error:
            raise Unavailable(
                f"{self.most} calls were in progress until the deadline; raise in_flight or timeout_s, "
                "or ask for many states in one call"
            ) from error
        if self.closed:
            turns.release()
            raise Unavailable(f"the client is closed: {call.__qualname__} was not called")
        left = max(deadline - loop.time(), 0.001)
        try:
            future = self._daemons.submit(functools.partial(call, *args, **kwargs, timeout_s=left))
        except BaseException:  # the system gives no thread
            turns.release()
            raise
        try:
            return await asyncio.wrap_future(future)
        finally:
            if future.done():
                turns.release()
            else:  # cancelled here; the thread is not done yet
                future.add_done_callback(functools.partial(_release, loop, turns))

    def _turns_in(self, loop: asyncio.AbstractEventLoop) -> asyncio.Semaphore:
        if (turns := self._turns.get(loop)) is None:
            for over in [one for one in self._turns if one.is_closed()]:  # one that was waited for holds its loop
                del self._turns[over]
            turns = self._turns[loop] = asyncio.Semaphore(self.most)
        return turns

    def close(self) -> None:
        """Takes no more calls."""
        self.closed = True
        self._end()


async def _aside(call: Callable[[], None]) -> None:
    """Calls it on a thread of its own: the loop's executor may be full of what ends only with it."""
    daemons = Daemons("crkr-async-close")
    future = daemons.submit(call)
    daemons.close()
    await asyncio.wrap_future(future)


def _release(loop: asyncio.AbstractEventLoop, turns: asyncio.Semaphore, _: Future[Any]) -> None:
    with suppress(RuntimeError):  # the loop is over, and nobody waits in it
        loop.call_soon_threadsafe(turns.release)


def _awaited(
    method: Callable[Concatenate[Task, _P], _T],
) -> Callable[Concatenate[AsyncTask, _P], Coroutine[Any, Any, _T]]:
    """The same method as a coroutine."""

    async def run(self: AsyncTask, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        named: dict[str, Any] = dict(kwargs)
        timeout_s = named.pop("timeout_s", None)
        return await self._calls.run(method, self.blocking, *args, timeout_s=timeout_s, **named)

    functools.update_wrapper(run, method)
    return run


@final
class AsyncTask:
    """`Task`, awaited: the same arguments, answers, deadlines and errors.

    Who is cancelled stops waiting; a report that was on its way is stored or not, and may be sent again under its id.

    Attributes:
        blocking: The task beneath, for what has no coroutine: `announce`, `mirror`, `outbox`.
    """

    def __init__(self, task: Task, calls: _Calls) -> None:
        self.blocking: Final = task
        self._calls = calls

    @property
    def name(self) -> str:
        """The task's name."""
        return self.blocking.name

    def __repr__(self) -> str:
        return f"AsyncTask({self.name!r})"

    predict = _awaited(Task.predict)
    report = _awaited(Task.report)
    report_trials = _awaited(Task.report_trials)
    status = _awaited(Task.status)
    model = _awaited(Task.model)
    samples = _awaited(Task.samples)
    explain = _awaited(Task.explain)
    recost = _awaited(Task.recost)
    remove = _awaited(Task.remove)
    refit = _awaited(Task.refit)
    configure = _awaited(Task.configure)
    archive = _awaited(Task.archive)

    async def iter_samples(self, after: int = 0) -> AsyncIterator[StoredTrial]:
        """Every stored trial with seq > `after`, in order, page by page."""
        position: int | None = after
        while position is not None:
            page, position = await self.samples(position)
            for entry in page:
                yield entry

    async def subscribe(
        self, topics: Sequence[str] = TOPICS, capacity: int = 4096, *, timeout_s: float | None = None
    ) -> AsyncSubscription:
        """Receives what workers ("trial", "evaluation") and the server ("model") publish, from now on."""
        return AsyncSubscription(await self._calls.run(self.blocking.subscribe, topics, capacity, timeout_s=timeout_s))


@final
class AsyncSubscription:
    """Publications as an asynchronous iterator of (topic, message); an asynchronous context manager, for one loop."""

    def __init__(self, subscription: Subscription) -> None:
        self._subscription = subscription
        self._daemons = Daemons("crkr-async-subscription")
        self._end = weakref.finalize(self, self._daemons.close)
        self._reading = asyncio.Lock()
        self._next: Future[tuple[str, dict[str, Any]] | None] | None = None  # what a thread is waiting for

    @property
    def dropped(self) -> int:
        """Publications lost here because the reader was slow."""
        return self._subscription.dropped

    async def receive(self, timeout_s: float) -> tuple[str, dict[str, Any]] | None:
        """The next publication, or None if there is none within `timeout_s` or ever again.

        Who is cancelled loses none: the next call has what came meanwhile.
        """
        check_not_forked()
        try:
            async with asyncio.timeout(timeout_s), self._reading:
                while (message := self._at_hand()) is None and not self._over():
                    if self._next is None:
                        wait = functools.partial(self._subscription.receive, _LISTEN_S)
                        self._next = self._daemons.submit(wait)
                    await asyncio.wrap_future(self._next)
                return message
        except TimeoutError:
            return self._at_hand()

    async def close(self) -> None:
        """Ends the subscription."""
        await _aside(self._subscription.close)
        self._end()

    def _at_hand(self) -> tuple[str, dict[str, Any]] | None:
        """What came, without waiting."""
        if self._next is not None:
            if not self._next.done():
                return None
            done, self._next = self._next, None
            if not done.cancelled() and (message := done.result()) is not None:
                return message
        return self._subscription.receive(0.0)

    def _over(self) -> bool:
        return self._next is None and self._subscription.closed

    def __aiter__(self) -> AsyncIterator[tuple[str, dict[str, Any]]]:
        return self._messages()

    async def _messages(self) -> AsyncIterator[tuple[str, dict[str, Any]]]:
        while True:
            message = await self.receive(_LISTEN_S)
            if message is not None:
                yield message
            elif self._over():
                return

    async def __aenter__(self) -> AsyncSubscription:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()


@final
class AsyncClient:
    """`Client`, awaited; an asynchronous context manager. It may serve one event loop after another.

    Attributes:
        blocking: The client beneath.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout_s: float = 5.0,
        zenoh_config: Path | str | None = None,
        in_flight: int = 64,
    ) -> None:
        """Notes where the server is; arguments as for `Client`.

        Args:
            endpoint: Zenoh endpoint; $CRKR_CONNECT or "tcp/127.0.0.1:7447" where absent.
            timeout_s: Deadline of calls that name none [s].
            zenoh_config: Zenoh configuration file (JSON5).
            in_flight: Calls in progress at a time; more wait for their turn, within their deadlines.

        Raises:
            Invalid: The endpoint, the time, the file or the number is not valid.
        """
        self.blocking: Final = Client(endpoint, timeout_s=timeout_s, zenoh_config=zenoh_config)
        self._calls = _Calls(in_flight, timeout_s)

    @property
    def endpoint(self) -> str:
        """Zenoh endpoint of the server."""
        return self.blocking.endpoint

    async def info(self, *, timeout_s: float | None = None) -> dict[str, Any]:
        """As `Client.info`."""
        return await self._calls.run(self.blocking.info, timeout_s=timeout_s)

    async def wait_until_ready(self, patience_s: float) -> dict[str, Any]:
        """As `Client.wait_until_ready`."""
        return await self._calls.run(self.blocking.info, timeout_s=patience_s)

    async def tasks(self, *, timeout_s: float | None = None) -> list[TaskSummary]:
        """As `Client.tasks`."""
        return await self._calls.run(self.blocking.tasks, timeout_s=timeout_s)

    async def iter_tasks(self) -> AsyncIterator[TaskSummary]:
        """As `Client.iter_tasks`."""
        after: int | None = 0
        while after is not None:
            page, after = await self._calls.run(self.blocking.task_page, after)
            for entry in page:
                yield entry

    async def create_task(self, spec: TaskSpec | Mapping[str, Any], *, timeout_s: float | None = None) -> AsyncTask:
        """As `Client.create_task`."""
        return AsyncTask(await self._calls.run(self.blocking.create_task, spec, timeout_s=timeout_s), self._calls)

    def task(self, name: str) -> AsyncTask:
        """A task by its name; whether it exists shows at the first call (`UnknownTask`)."""
        return AsyncTask(self.blocking.task(name), self._calls)

    def __repr__(self) -> str:
        return f"AsyncClient({self.endpoint!r})"

    async def close(self) -> None:
        """Ends the connection; calls in progress end with `Unavailable`."""
        self._calls.close()
        await _aside(self.blocking.close)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
