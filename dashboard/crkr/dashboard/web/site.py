"""The tasks of a server as a read-only site: a list, and a page for each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final, final

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from crkr.client import Client
from crkr.dashboard.page.document import document, policy, task_list
from crkr.dashboard.page.markup import tag
from crkr.dashboard.web.followed_task import FollowedTask
from crkr.protocol import Busy, CrkrError, Invalid, UnknownTask

__all__ = ["Site", "application"]

MOST: Final = 16  # tasks followed at once
IN_USE_S: Final = 30.0  # time since the last look before a task may be dropped
LISTED: Final = 200  # names on one page of the list
TIMEOUT_S: Final = 2.0


@final
class Site:
    """The tasks whose pages are open.

    Args:
        connect: Makes a client; its deadline bounds how long a reader waits.
    """

    def __init__(self, connect: Callable[[], Client]) -> None:
        self._connect = connect
        self._client = connect()
        self._followed: dict[str, FollowedTask] = {}
        self._changing = threading.Lock()
        self._asking = threading.Lock()

    def known(self, name: str) -> FollowedTask | None:
        """A task that is followed already."""
        return self._followed.get(name)

    def task(self, name: str) -> FollowedTask:
        """Follows a task; may wait for the server.

        Raises:
            UnknownTask: No such task.
            Invalid: That cannot be a task's name.
            Unavailable: The server does not answer.
            Busy: Too many tasks are looked at.
        """
        with self._changing:  # one question at a time, for any names
            if name not in self._followed:
                spec = self._client.task(name).spec
                self._make_room()
                self._followed[name] = FollowedTask(self._connect, spec)
            return self._followed[name]

    def _make_room(self) -> None:
        if len(self._followed) < MOST:
            return
        name, oldest = min(self._followed.items(), key=lambda each: each[1].asked)
        if time.monotonic() - oldest.asked < IN_USE_S:
            raise Busy(f"{MOST} tasks are looked at; try again in a moment")
        del self._followed[name]
        oldest.close()

    def names(self, after: int) -> tuple[list[str], int | None]:
        """Names of tasks beyond the first `after`, and the next `after`."""
        with self._asking:
            page, following = self._client.task_page(after)
        names = [summary["spec"].name for summary in page]
        return names[:LISTED], after + LISTED if len(names) > LISTED else following

    def close(self) -> None:
        """Stop following."""
        for task in self._followed.values():
            task.close()
        self._client.close()


def application(site: Site, hosts: frozenset[str] | None) -> ASGIApp:
    """The site as an ASGI application.

    Args:
        site: What it shows.
        hosts: Allowed host names; None: any. Others are refused, so that a foreign site whose name resolves to this
            address cannot read the pages.
    """

    async def listing(request: Request) -> Response:
        after = request.query_params.get("after", "0")
        if not after.isascii() or not after.isdigit() or len(after) > 9:
            return _told(400, "after is a whole number")
        try:
            names, following = await run_in_threadpool(site.names, int(after))
        except CrkrError as error:
            return _refusal(error)
        return HTMLResponse(task_list(names, None if following is None else f"?after={following}"))

    async def page(request: Request) -> Response:
        name = request.path_params["name"]
        try:
            if site.known(name) is None:
                await run_in_threadpool(site.task, name)
        except CrkrError as error:
            return _refusal(error)
        head = tag("div", tag("h1", name, tag("span", "loading", klass="pill")), id="head")
        return HTMLResponse(document(name, [head], "It renews itself.", f"{name}/parts"))

    async def parts(request: Request) -> Response:
        name = request.path_params["name"]
        try:
            task = site.known(name)
            if task is None:
                task = await run_in_threadpool(site.task, name)
        except CrkrError as error:
            return _refusal(error)
        made = task.look()
        if request.query_params.get("known") == made.version:
            return Response(status_code=204)
        if "gzip" in request.headers.get("accept-encoding", ""):
            return Response(made.packed, media_type="application/json", headers={"content-encoding": "gzip"})
        return Response(made.body, media_type="application/json")

    routes = [
        Route("/", listing, methods=["GET"]),
        Route("/task/{name}", page, methods=["GET"]),
        Route("/task/{name}/parts", parts, methods=["GET"]),
    ]
    inner = Starlette(routes=routes)
    inner.router.redirect_slashes = False
    return _Guard(inner, hosts)


@final
class _Guard:
    """Refuses foreign names of the host, and sets the headers that every answer has."""

    def __init__(self, inner: ASGIApp, hosts: frozenset[str] | None) -> None:
        self._inner = inner
        self._hosts = hosts
        named = {
            "content-security-policy": f"{policy(live=True)}; frame-ancestors 'none'",
            "x-content-type-options": "nosniff",
            "referrer-policy": "no-referrer",
            "cross-origin-resource-policy": "same-origin",
            "cache-control": "no-store",
        }
        self._headers = [(name.encode(), value.encode()) for name, value in named.items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *self._headers]
            await send(message)

        if scope["type"] != "http":
            return
        asked = dict(scope["headers"]).get(b"host", b"").decode("latin-1")
        inner = self._inner if self._hosts is None or _host(asked) in self._hosts else _told(421, "not this host")
        await inner(scope, receive, send_with_headers)


def _host(given: str) -> str:
    """The name in a Host header, without its port."""
    name, _, port = given.rpartition(":")
    return (name if name and port.isdigit() else given).strip("[]").lower()


def _refusal(error: CrkrError) -> Response:
    if isinstance(error, UnknownTask | Invalid):
        return _told(404, "there is no such task")
    return _told(503, "too many tasks are looked at" if isinstance(error, Busy) else "the server does not answer")


def _told(status: int, text: str) -> Response:
    return PlainTextResponse(f"{text}\n", status_code=status)
