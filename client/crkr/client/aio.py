"""The client for programs that live in an event loop: the same calls, awaited.

Each call in progress blocks a thread. Zenoh has no coroutines, and a bridge from its threads to the loop carries fewer
calls a second than blocked threads do.
"""

from __future__ import annotations

import asyncio
import functools
import weakref
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Concatenate, Final, ParamSpec, TypeVar, final

from crkr.client.call_threads import TIMED_OUT, AwaitedCalls, CallThreads, run_aside, timeout_at
from crkr.client.client import Client, TaskSummary
from crkr.client.lifetimes import AsyncClosing, check_not_forked
from crkr.client.network.subscription import TOPICS, Subscription
from crkr.client.task import Task
from crkr.protocol import StoredTrial, TaskSpec

__all__ = ["AsyncClient", "AsyncSubscription", "AsyncTask"]

_P = ParamSpec("_P")
_T = TypeVar("_T")
_LISTEN_S: Final = 0.5  # a thread that waits for publications checks this often whether the subscription is closed


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

    Cancelling only stops the wait. A report in flight may or may not have been stored; resend it under the same id.

    Attributes:
        blocking: The `Task`, for what has no coroutine: `announce`, `mirror`, `outbox`.
    """

    def __init__(self, task: Task, calls: AwaitedCalls) -> None:
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
    trials = _awaited(Task.trials)
    explain = _awaited(Task.explain)
    recost = _awaited(Task.recost)
    remove = _awaited(Task.remove)
    amend = _awaited(Task.amend)
    undo = _awaited(Task.undo)
    rollback = _awaited(Task.rollback)
    rename = _awaited(Task.rename)
    delete = _awaited(Task.delete)
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
class AsyncSubscription(AsyncClosing):
    """Publications as an asynchronous iterator of (topic, message); an asynchronous context manager, for one loop."""

    def __init__(self, subscription: Subscription) -> None:
        self._subscription = subscription
        self._threads = CallThreads("crkr-async-subscription")
        self._end = weakref.finalize(self, self._threads.close)
        self._reading = asyncio.Lock()
        self._next: Future[tuple[str, dict[str, Any]] | None] | None = None  # a thread waits for it

    @property
    def dropped(self) -> int:
        """Publications lost here because the reader was slow."""
        return self._subscription.dropped

    async def receive(self, timeout_s: float) -> tuple[str, dict[str, Any]] | None:
        """The next publication, or None if there is none within `timeout_s` or ever again.

        Cancelling loses nothing: the next call returns what came meanwhile.
        """
        check_not_forked()
        try:
            async with timeout_at(asyncio.get_running_loop().time() + timeout_s), self._reading:
                while (message := self._at_hand()) is None and not self._over():
                    if self._next is None:
                        wait = functools.partial(self._subscription.receive, _LISTEN_S)
                        self._next = self._threads.submit(wait)
                    await asyncio.wrap_future(self._next)
                return message
        except TIMED_OUT:
            return self._at_hand()

    async def close(self) -> None:
        """Ends the subscription."""
        await run_aside(self._subscription.close)
        self._end()

    def _at_hand(self) -> tuple[str, dict[str, Any]] | None:
        """The next publication if it is here already."""
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


@final
class AsyncClient(AsyncClosing):
    """`Client`, awaited; an asynchronous context manager. It may serve one event loop after another.

    Attributes:
        blocking: The `Client`.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout_s: float = 5.0,
        zenoh_config: Path | str | None = None,
        in_flight: int = 64,
    ) -> None:
        """Connects at the first call; arguments as for `Client`.

        Args:
            endpoint: Zenoh endpoint; $CRKR_CONNECT or "tcp/127.0.0.1:7447" where absent.
            timeout_s: Deadline of calls that name none [s].
            zenoh_config: Zenoh configuration file (JSON5).
            in_flight: Most calls in progress at a time; further calls wait, within their deadlines.

        Raises:
            Invalid: The endpoint, the time, the file or the number is not valid.
        """
        self.blocking: Final = Client(endpoint, timeout_s=timeout_s, zenoh_config=zenoh_config)
        self._calls = AwaitedCalls(in_flight, timeout_s)

    @property
    def endpoint(self) -> str:
        """Zenoh endpoint of the server."""
        return self.blocking.endpoint

    @property
    def in_progress(self) -> int:
        """Calls that a thread is busy with; a cancelled call counts until its thread is free."""
        return self._calls.in_progress

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
        """A task by its name; the first call raises `UnknownTask` if it does not exist."""
        return AsyncTask(self.blocking.task(name), self._calls)

    def __repr__(self) -> str:
        return f"AsyncClient({self.endpoint!r})"

    async def close(self) -> None:
        """Ends the connection; calls in progress end with `Unavailable`."""
        self._calls.close()
        await run_aside(self.blocking.close)
