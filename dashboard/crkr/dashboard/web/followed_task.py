"""Follows a task on a thread while somebody views its page, and keeps the newest page as bytes."""

from __future__ import annotations

import gzip
import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

from crkr.client import Client
from crkr.dashboard.feed import Feed
from crkr.dashboard.live_session import follow
from crkr.dashboard.page.markup import html
from crkr.dashboard.page.view import PageView
from crkr.dashboard.progress import Progress
from crkr.protocol import CrkrError, TaskSpec

__all__ = ["FollowedTask", "PageBytes"]

logger = logging.getLogger(__name__)

TICK_S: Final = 0.25
RENEW_S: Final = 2.0  # between two versions of a page
IDLE_S: Final = 60.0  # without a reader, after which the task is no longer followed
RETRY_S: Final = 1.0
REST: Final = 1.0  # while a long log is read, ask the server half of the time at most
ENDS_S: Final = 5.0


@final
@dataclass(frozen=True, slots=True)
class PageBytes:
    """One version of a page.

    Attributes:
        version: A new one for each, also between processes.
        body: JSON with the version and the parts [[id, HTML], ...].
        packed: The same, compressed by gzip.
    """

    version: str
    body: bytes
    packed: bytes


@final
class FollowedTask:
    """A task's current page. Slow work runs on a separate thread, so that readers get bytes at once."""

    def __init__(self, connect: Callable[[], Client], spec: TaskSpec) -> None:
        self._connect = connect
        self._name = spec.name
        progress = Progress(running=False)
        self._view = PageView(spec, progress, live=True)
        self._feed = Feed(self._view, progress)
        self._begun = f"{time.time():.6f}"
        self._count = 0
        self._asked = time.monotonic()
        self._made = 0.0
        self._newest = self._render()
        self._stop, self._awake = threading.Event(), threading.Event()
        self._awake.set()
        self._thread = threading.Thread(target=self._run, name=f"page of {spec.name}", daemon=True)
        self._thread.start()

    @property
    def asked(self) -> float:
        """Time of the last look, monotonic [s]."""
        return self._asked

    def look(self) -> PageBytes:
        """The newest version of the page; each call keeps the task followed."""
        self._asked = time.monotonic()
        self._awake.set()
        return self._newest

    def close(self) -> None:
        """Stop following."""
        self._stop.set()
        self._awake.set()
        self._thread.join(ENDS_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            if not self._is_looked_at():
                self._awake.clear()
                if not self._stop.is_set() and not self._is_looked_at():  # a new look would be missed
                    self._awake.wait(IDLE_S)
                self._view.resume(time.monotonic())
                continue
            try:
                self._follow()
            except Exception:
                logger.exception("the page of task %s could not be made", self._name)
                self._stop.wait(RETRY_S)

    def _follow(self) -> None:
        try:
            with self._connect() as client:
                follow(client, client.task(self._name), self._feed, TICK_S, self._goes_on, rest=REST)
        except CrkrError as error:
            logger.info("the page of task %s waits: %s", self._name, error.message)
            self._goes_on()
            self._stop.wait(RETRY_S)

    def _is_looked_at(self) -> bool:
        return time.monotonic() - self._asked < IDLE_S

    def _goes_on(self) -> bool:
        """Renew the page if it is due; returns whether to continue."""
        if time.monotonic() - self._made >= RENEW_S:
            self._newest = self._render()
        return self._is_looked_at() and not self._stop.is_set()

    def _render(self) -> PageBytes:
        self._count += 1
        version = f"{self._begun}-{self._count}"
        parts = [[part.get("id"), html(part)] for part in self._view.parts()]
        body = json.dumps({"version": version, "parts": parts}).encode()
        self._made = time.monotonic()
        return PageBytes(version, body, gzip.compress(body, 5, mtime=0))
