"""The interface of a task log, so that another database can replace SQLite."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol
from uuid import UUID

from crkr.learner import TrialColumns
from crkr.protocol import Conflict, TaskSpec
from crkr.server.log.entries import Event, LoggedTrial, PendingReport, Stored

__all__ = ["LogReader", "TaskLog"]


class LogReader(Protocol):
    """Reads events of many tasks, from any thread.

    Every method raises `StorageError` when the store cannot be read.
    """

    def tasks(self) -> tuple[str, ...]:
        """Names of all tasks, oldest first."""
        ...

    def last(self, task: str) -> int:
        """Log position of the task's last entry."""
        ...

    def read(self, task: str, after: int = 0) -> Iterator[LoggedTrial | Event]:
        """All entries past a log position, in order, checked against their digests."""
        ...

    def blocks(
        self, task: str, dimensions: int, outputs: int, measured: int, upto: int
    ) -> Iterator[TrialColumns | Event]:
        """The entries up to a log position as `read` gives them, neighbouring trials together; many times quicker."""
        ...

    def page(self, task: str, after: int, limit: int, most_bytes: int) -> tuple[list[dict[str, Any]], int | None]:
        """Trials past a log position as wire maps with their present costs, and where to go on (None at the end)."""
        ...

    def page_before(
        self, task: str, before: int | None, limit: int, most_bytes: int
    ) -> tuple[list[dict[str, Any]], int | None]:
        """The same backwards: trials before a log position (None: from the end), newest first, and where to go on."""
        ...

    def trials(self, task: str, ids: Sequence[UUID]) -> list[dict[str, Any]]:
        """Trials by their ids, as in `page` and in the order asked; unknown ids are left out."""
        ...

    def events(self, task: str) -> Iterator[Event]:
        """All events in order, without the trials."""
        ...

    def event(self, task: str, seq: int) -> Event | None:
        """The event at a log position, None where there is none."""
        ...

    def load_cache(self, task: str) -> tuple[int, bytes] | None:
        """The cached bytes and their log position; None if missing or damaged."""
        ...

    def integrity(self) -> list[str]:
        """Errors that the store finds in its own layout; reads everything."""
        ...

    def backup(self, target: Path) -> None:
        """Copy the present log into a new file, which gets its name only once it is complete."""
        ...


class TaskLog(Protocol):
    """Stores events of many tasks, durably before a method returns, one write at a time.

    Every method raises `StorageError` when the store cannot be written; nothing is half written then.
    """

    @property
    def reads(self) -> LogReader:
        """The reading side."""
        ...

    def create(self, spec: TaskSpec) -> Event:
        """Store a new task; its create event has seq 1."""
        ...

    def append_reports(self, reports: Sequence[PendingReport]) -> list[Stored | Conflict]:
        """Store several reports in one transaction; a report in conflict leaves the others alone."""
        ...

    def append_event(self, task: str, kind: str, body: Mapping[str, Any]) -> Event:
        """Store an event and update the trials it names; a `rename` or `delete` gives the task the name in its body."""
        ...

    def purge(self) -> list[str]:
        """Remove deleted tasks for good; returns the names that they had in the log."""
        ...

    def save_cache(self, task: str, version: int, data: bytes) -> None:
        """Cache bytes that belong to a log position, replacing earlier ones."""
        ...

    def close(self) -> None:
        """End all work; idempotent. Raises `StorageError` if work outlasts the patience; it then ends by itself."""
        ...
