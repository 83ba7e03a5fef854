"""The interface of a task log, which SQLite and PostgreSQL implement."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol
from uuid import UUID

from crkr.protocol import Conflict, ShuttingDown, TaskSpec
from crkr.server.log.entries import Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.reader import LogReader

__all__ = ["TaskLog"]


class TaskLog(Protocol):
    """Stores events of many tasks, one write at a time; they are durable when a method returns.

    Every method raises `StorageError` if the store cannot be written; nothing is half written. A writing method raises
    `ShuttingDown` if the store is away, or another server owns it; the request may be sent again.
    """

    @property
    def reads(self) -> LogReader:
        """The reading side."""

    @property
    def where(self) -> str:
        """The place, for messages."""

    @property
    def log_id(self) -> UUID | None:
        """Identifies a log that several servers share."""

    def recover(self) -> list[tuple[str, list[LoggedTrial | Event]]]:
        """Tasks and entries that were stored although the write raised `ShuttingDown`.

        Called before each write. Raises as the writing methods do while the store is away.
        """

    def create(self, spec: TaskSpec) -> Event:
        """Store a new task; its create event has seq 1."""

    def append_reports(self, reports: Sequence[PendingReport]) -> Sequence[Stored | Conflict | ShuttingDown]:
        """Store several reports in one transaction; a report in conflict leaves the others alone.

        The result is `ShuttingDown` for a report of a task that another server owns now.
        """

    def append_event(self, task: str, kind: str, body: Mapping[str, Any]) -> Event:
        """Store an event and update the trials it names; a `rename` or `delete` gives the task the name in its body."""

    def purge(self) -> list[str]:
        """Remove deleted tasks from the log; returns the names that they had there."""

    def adopt(self, task: str, events: Iterable[tuple[Any, ...]], trials: Iterable[tuple[Any, ...]]) -> int:
        """Store a task's rows of another log, from `LogReader.raw`; returns their number."""

    def save_cache(self, task: str, version: int, data: bytes) -> None:
        """Cache bytes that belong to a log position, replacing earlier ones."""

    def sizes(self) -> tuple[int | None, int | None]:
        """Bytes of the log, and those free for it; None where unknown."""

    def close(self) -> None:
        """End all work; idempotent. Raises `StorageError` if work outlasts the patience; it then ends by itself."""
