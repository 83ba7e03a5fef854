"""Reads a task log from any thread, on either database, without blocking a server that writes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from itertools import chain
from typing import Any, Final, Protocol, final
from uuid import UUID

import numpy as np

from crkr.learner import TrialColumns
from crkr.protocol import StorageError, UnknownTask, unpack
from crkr.server.log.acknowledged_count import lost_end
from crkr.server.log.blocks import BLOCK_COLUMNS, columns_of
from crkr.server.log.entries import Event, LoggedTrial
from crkr.server.log.rows import ROW_COLUMNS, body_digest, check_row, trial_of, wire_of

__all__ = ["Database", "LogReader"]

# Statements that every database of a log understands; ? stands for a value.
_TASKS: Final = "SELECT name FROM task ORDER BY id"
_KEY: Final = "SELECT id FROM task WHERE name = ?"
_TRIAL: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND id = ?"
_TRIALS: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND seq > ? AND seq <= ? ORDER BY seq LIMIT ?"
_BLOCKS: Final = f"SELECT {BLOCK_COLUMNS} FROM trial WHERE task = ? AND seq > ? AND seq <= ? ORDER BY seq LIMIT ?"
_EVENTS: Final = """SELECT seq, time, kind, body, digest FROM event WHERE task = ? AND seq > ? AND seq <= ?
                    ORDER BY seq LIMIT ?"""
_ROLLBACKS: Final = _EVENTS.replace("ORDER", "AND kind = 'rollback' ORDER")
_EVENT: Final = "SELECT seq, time, kind, body, digest FROM event WHERE task = ? AND seq = ?"
_MOVES: Final = "SELECT seq, time, kind, body, digest FROM event WHERE kind IN ('rename', 'delete')"
_PAGE: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND seq > ? ORDER BY seq LIMIT ?"
_PAGE_BEFORE: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND seq < ? ORDER BY seq DESC LIMIT ?"
_END: Final = 2**62  # beyond every log position
_POSITIONS: Final = """SELECT id, name, (SELECT coalesce(max(seq), 0) FROM trial WHERE task = task_of.id),
                              (SELECT coalesce(max(seq), 0) FROM event WHERE task = task_of.id)
                       FROM task AS task_of"""
_CACHE: Final = "SELECT version, data, digest FROM cache WHERE task = ?"
_BLOCK: Final = 4096  # trials read together
_FEW: Final = 64  # events per query: each may be large
_PAGE_BYTES: Final = 2**18  # of rows read together; larger rows are read one by one
_SHARE: Final = 512  # rows of a page read together: each may be large
_ROW_BYTES: Final = 240  # of a page entry, its vectors and info aside


class Database(Protocol):
    """The tables of a log. Each thread has its own connection, which sees whole commits only."""

    @property
    def where(self) -> str:
        """The place, for messages."""

    @property
    def is_log(self) -> bool:
        """Whether there are tables in it."""

    @property
    def acknowledged(self) -> int:
        """Number of log positions of all tasks that were certainly acknowledged; 0 if unknown."""

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """The rows that a statement gives; ? stands for a value."""

    def errors(self, doing: str) -> AbstractContextManager[None]:
        """Turn database errors, and columns of a wrong type, into `StorageError`."""

    def snapshot(self) -> AbstractContextManager[None]:
        """Context in which this thread reads the log as of the first read."""

    def integrity(self) -> list[str]:
        """Errors that the database finds in its layout; reads everything."""

    def close(self) -> None:
        """Close the connections of this thread and of those that ended; idempotent."""


@final
class LogReader:
    """Reads entries of all tasks. Every method raises `StorageError` if the store cannot be read.

    Attributes:
        where: The place of the log, for messages.
        is_log: There are tables in it.
        snapshot: Context in which this thread reads the log as of the first read.
        integrity: Errors that the store finds in its layout; reads everything.
        close: Closes the connections of this thread and of those that ended; idempotent.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self.where: Final = database.where
        self.is_log: Final = database.is_log
        self.snapshot: Final = database.snapshot
        self.integrity: Final = database.integrity
        self.close: Final = database.close

    def tasks(self) -> tuple[str, ...]:
        """Names of all tasks, oldest first."""
        with self._database.errors("list the tasks"):
            return tuple(str(name) for (name,) in self._database.rows(_TASKS))

    def last(self, task: str) -> int:
        """Log position of the task's last entry."""
        with self._database.errors(f"read the log of task {task!r}"):
            return self._last(self._key(task))

    def positions(self) -> dict[str, int]:
        """Log position of every task's last entry, oldest task first; empty if there are no tables yet.

        Raises:
            StorageError: There are entries of a task that is not listed.
        """
        if not self.is_log:
            return {}
        with self._database.errors(f"find the end of the task log {self.where}"):
            found = self._database.rows(f"{_POSITIONS} ORDER BY id")
            if self._database.rows("SELECT DISTINCT task FROM event EXCEPT SELECT id FROM task"):
                raise StorageError(f"{self.where} holds entries of tasks that it does not list; restore a backup")
            return {str(name): max(int(trial), int(event)) for _, name, trial, event in found}

    def lost_end(self) -> str:
        """Error text for a log that lacks acknowledged entries; "" if it lacks none."""
        acknowledged = self._database.acknowledged
        held = sum(self.positions().values())
        return lost_end(self.where, held, acknowledged) if held < acknowledged else ""

    def trials(self, task: str, ids: Sequence[UUID]) -> list[dict[str, Any]]:
        """Trials by their ids, as in `page` and in the order asked; unknown ids are left out."""
        with self._database.errors("look up trials"):
            key = self._key(task)
            return [wire_of(row) for one in ids for row in self._database.rows(_TRIAL, key, one.bytes)]

    def events(self, task: str) -> Iterator[Event]:
        """All events in order, without the trials."""
        with self._database.errors(f"read the log of task {task!r}"):
            yield from map(_event, self._pages(_EVENTS, self._key(task), 0, _END, _FEW))

    def rollbacks(self, task: str) -> Iterator[Event]:
        """All rollbacks in order. Other events, which may be large, are not read."""
        with self._database.errors(f"read the log of task {task!r}"):
            yield from map(_event, self._pages(_ROLLBACKS, self._key(task), 0, _END, _FEW))

    def event(self, task: str, seq: int) -> Event | None:
        """The event at a log position, or None."""
        with self._database.errors(f"read the log of task {task!r}"):
            return next(map(_event, self._database.rows(_EVENT, self._key(task), seq)), None)

    def moves(self) -> list[Event]:
        """Every rename and delete of any task."""
        with self._database.errors("read which tasks were renamed or deleted"):
            return [_event(row) for row in self._database.rows(_MOVES)]

    def read(self, task: str, after: int = 0) -> Iterator[LoggedTrial | Event]:
        """All entries past a log position, in order; raises `StorageError` at the first that is damaged or missing."""
        with self._database.errors(f"read the log of task {task!r}"):
            key = self._key(task)
            upto = self._last(key)  # entries that are added meanwhile are left out
            events = map(_event, self._pages(_EVENTS, key, after, upto, _FEW))
            event = next(events, None)
            expected = after
            for row in self._pages(_TRIALS, key, after, upto, _SHARE):
                while event is not None and event.seq < row[0]:
                    expected = _follows(task, event.seq, expected)
                    yield event
                    event = next(events, None)
                expected = _follows(task, row[0], expected)
                yield trial_of(row)
            while event is not None:
                expected = _follows(task, event.seq, expected)
                yield event
                event = next(events, None)

    def blocks(
        self, task: str, dimensions: int, outputs: int, measured: int, upto: int
    ) -> Iterator[TrialColumns | Event]:
        """The entries up to a log position as in `read`, successive trials together; many times faster."""
        with self._database.errors(f"read the log of task {task!r}"):
            key = self._key(task)
            events = map(_event, self._pages(_EVENTS, key, 0, upto, _FEW))
            expected = 0
            for event in chain(events, (None,)):
                before = upto + 1 if event is None else event.seq
                while rows := self._database.rows(_BLOCKS, key, expected, before - 1, _BLOCK):
                    block = columns_of(rows, dimensions, outputs, measured)
                    gaps = np.flatnonzero(np.diff(block.seqs, prepend=expected) != 1)
                    if len(gaps):
                        _follows(task, int(block.seqs[gaps[0]]), expected + int(gaps[0]))
                    expected = int(block.seqs[-1])
                    yield block
                if event is not None:
                    expected = _follows(task, event.seq, expected)
                    yield event

    def page(self, task: str, after: int, limit: int, most_bytes: int) -> tuple[list[dict[str, Any]], int | None]:
        """Trials past a log position as wire maps with current costs, and the next position (None at the end)."""
        return self._page(_PAGE, task, after, limit, most_bytes)

    def page_before(
        self, task: str, before: int | None, limit: int, most_bytes: int
    ) -> tuple[list[dict[str, Any]], int | None]:
        """The same backwards: trials before a log position (None: the end), newest first, and the next position."""
        return self._page(_PAGE_BEFORE, task, _END if before is None else before, limit, most_bytes)

    def _page(
        self, statement: str, task: str, start: int, limit: int, most_bytes: int
    ) -> tuple[list[dict[str, Any]], int | None]:
        entries: list[dict[str, Any]] = []
        size, share = 0, min(limit + 1, _SHARE)
        with self._database.errors(f"read samples of task {task!r}"):
            key = self._key(task)
            while rows := self._database.rows(statement, key, start, share):
                for row in rows:
                    size += _ROW_BYTES + sum(_bytes(value) for value in row)
                    if entries and (len(entries) == limit or size > most_bytes):
                        return entries, int(entries[-1]["seq"])
                    entries.append(wire_of(row))
                start = int(rows[-1][0])
        return entries, None

    def check(self, task: str, upto: int) -> None:
        """Raise `StorageError` for the first damaged trial up to a log position."""
        with self._database.errors(f"check the rows of task {task!r}"):
            for row in self._pages(_TRIALS, self._key(task), 0, upto, _BLOCK):
                check_row(row)

    def raw(self, task: str) -> tuple[Iterator[tuple[Any, ...]], Iterator[tuple[Any, ...]]]:
        """A task's event and trial rows without the task's key, to be stored elsewhere."""
        with self._database.errors(f"read the log of task {task!r}"):
            key = self._key(task)
            upto = self._last(key)
        return self._raw(task, _EVENTS, key, upto, _FEW), self._raw(task, _TRIALS, key, upto, _BLOCK)

    def _raw(self, task: str, statement: str, key: int, upto: int, share: int) -> Iterator[tuple[Any, ...]]:
        with self._database.errors(f"read the log of task {task!r}"):
            yield from self._pages(statement, key, 0, upto, share)

    def load_cache(self, task: str) -> tuple[int, bytes] | None:
        """The cached bytes and their log position; None if missing or damaged."""
        with self._database.errors(f"read the cache of task {task!r}"):
            found = self._database.rows(_CACHE, self._key(task))
        for version, data, digest in found:
            if body_digest(f"cache {version}", data) == digest:
                return int(version), data
        return None

    def _key(self, task: str) -> int:
        for (key,) in self._database.rows(_KEY, task):
            return int(key)
        raise UnknownTask(f"the log holds no task {task!r}", details={"task": task})

    def _last(self, key: int) -> int:
        [(_, _, trial, event)] = self._database.rows(f"{_POSITIONS} WHERE id = ?", key)
        return max(int(trial), int(event))

    def _pages(self, statement: str, key: int, after: int, upto: int, share: int) -> Iterator[tuple[Any, ...]]:
        """Rows in order of seq, few at a time: a long read would keep the database from its clean-up."""
        wanted = 1
        while rows := self._database.rows(statement, key, after, upto, wanted):
            yield from rows
            if len(rows) < wanted:
                return
            after = int(rows[-1][0])
            small = sum(_bytes(value) for row in rows for value in row) <= _PAGE_BYTES
            wanted = min(share, 4 * wanted) if small else 1


def _bytes(value: object) -> int:
    """Most bytes that a column takes in a message, without numbers."""
    return len(value) if isinstance(value, bytes) else 4 * len(value) if isinstance(value, str) else 0


def _event(row: tuple[Any, ...]) -> Event:
    seq, now, kind, body, digest = row
    if body_digest(kind, body) != digest:
        raise StorageError(f"the {kind} event at log position {seq} does not match its digest; restore a backup")
    return Event(seq, now, kind, unpack(body, depth=None))


def _follows(task: str, seq: int, before: int) -> int:
    if seq != before + 1:
        raise StorageError(f"the log of task {task!r} lacks position {before + 1}; restore a backup")
    return seq
