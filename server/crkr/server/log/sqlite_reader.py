"""Reads the task log from any thread, without blocking a server that writes."""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, takewhile
from pathlib import Path
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.learner import TrialColumns
from crkr.protocol import StorageError, UnknownTask, unpack
from crkr.server.log.blocks import BLOCK_COLUMNS, columns_of
from crkr.server.log.data_files import check_database_files
from crkr.server.log.entries import Event, LoggedTrial
from crkr.server.log.journal_check import refuse_foreign_wal
from crkr.server.log.rows import ROW_COLUMNS, body_digest, check_row, trial_of, wire_of
from crkr.server.log.schema import check_version, connect, read_errors, storage_errors

__all__ = ["SqliteReader"]

_TRIAL: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND id = ?"
_READ_TRIALS: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND seq > ? ORDER BY seq"
_READ_BLOCKS: Final = f"SELECT {BLOCK_COLUMNS} FROM trial WHERE task = ? AND seq > ? AND seq < ? ORDER BY seq"
_READ_SPAN: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND seq > ? AND seq <= ?"
_BLOCK: Final = 4096  # trials read together
_READ_EVENTS: Final = "SELECT seq, time, kind, body, digest FROM event WHERE task = ? AND seq > ? ORDER BY seq"
_EVENT: Final = "SELECT seq, time, kind, body, digest FROM event WHERE task = ? AND seq = ?"
_PAGE: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND seq > ? ORDER BY seq LIMIT ?"
_PAGE_BEFORE: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND seq < ? ORDER BY seq DESC LIMIT ?"
_END: Final = 2**62  # beyond every log position
_LAST: Final = """SELECT max((SELECT coalesce(max(seq), 0) FROM trial WHERE task = :task),
                            (SELECT coalesce(max(seq), 0) FROM event WHERE task = :task))"""
_ROW_BYTES: Final = 240  # of a page entry, its vectors and info aside


@final
class SqliteReader:
    """A `LogReader` of a database file. Each thread has its own connection, which sees whole commits only.

    Attributes:
        path: The file.
        is_log: There are tables in it.

    Raises:
        StorageError: There is no log, it is damaged, or of a newer version.
    """

    def __init__(self, path: Path) -> None:
        check_database_files(path)
        if not path.is_file() or not path.stat().st_size:  # beside an empty database SQLite deletes the write-ahead log
            raise StorageError(f"there is no task log {path}")
        self.path = path
        self._threads = threading.local()
        self._open: list[tuple[threading.Thread, sqlite3.Connection]] = []
        try:
            with read_errors(f"open the task log {path}"):
                self.is_log: Final = check_version(self._connection(), path)
                if self.is_log:
                    refuse_foreign_wal(self._connection(), path)
        except StorageError:
            self.close()
            raise

    def tasks(self) -> tuple[str, ...]:
        """Names of all tasks, oldest first."""
        with read_errors("list the tasks"):
            return tuple(name for (name,) in self._connection().execute("SELECT name FROM task ORDER BY id"))

    def last(self, task: str) -> int:
        """Log position of the task's last entry."""
        with read_errors(f"read the log of task {task!r}"):
            return int(self._connection().execute(_LAST, {"task": self._key(task)}).fetchone()[0])

    def positions(self) -> dict[str, int]:
        """Log position of every task's last entry; empty if there are no tables yet.

        Raises:
            StorageError: There are entries of a task that is not listed.
        """
        if not self.is_log:
            return {}
        with read_errors(f"find the end of the task log {self.path}"):
            connection = self._connection()
            names = {int(key): str(name) for key, name in connection.execute("SELECT id, name FROM task ORDER BY id")}
            if {key for (key,) in connection.execute("SELECT DISTINCT task FROM event")} - names.keys():
                raise StorageError(f"{self.path} holds entries of tasks that it does not list; restore a backup")
            last = {key: connection.execute(_LAST, {"task": key}).fetchone()[0] for key in names}
            return {name: int(last[key]) for key, name in names.items()}

    def trials(self, task: str, ids: Sequence[UUID]) -> list[dict[str, Any]]:
        """Trials by their ids, as in `page` and in the order asked; unknown ids are left out."""
        with read_errors("look up trials"):
            reader, key = self._connection(), self._key(task)
            rows = (reader.execute(_TRIAL, (key, one.bytes)).fetchone() for one in ids)
            return [wire_of(row) for row in rows if row is not None]

    def events(self, task: str) -> Iterator[Event]:
        """All events in order, without the trials."""
        with read_errors(f"read the log of task {task!r}"):
            yield from map(_event, self._connection().execute(_READ_EVENTS, (self._key(task), 0)))

    def event(self, task: str, seq: int) -> Event | None:
        """The event at a log position, None where there is none."""
        with read_errors(f"read the log of task {task!r}"):
            row = self._connection().execute(_EVENT, (self._key(task), seq)).fetchone()
            return None if row is None else _event(row)

    def read(self, task: str, after: int = 0) -> Iterator[LoggedTrial | Event]:
        """All entries past a log position, in order; raises `StorageError` at the first that is damaged or missing."""
        with read_errors(f"read the log of task {task!r}"):
            connection, key = self._connection(), self._key(task)
            events = map(_event, connection.execute(_READ_EVENTS, (key, after)))  # one at a time: each may be large
            event = next(events, None)
            expected = after
            for row in connection.execute(_READ_TRIALS, (key, after)):
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
        """The entries up to a log position as `read` gives them, neighbouring trials together; many times quicker."""
        with read_errors(f"read the log of task {task!r}"):
            connection, key = self._connection(), self._key(task)
            events = map(_event, connection.execute(_READ_EVENTS, (key, 0)))
            wanted: Iterator[Event] = takewhile(lambda one: one.seq <= upto, events)
            expected = 0
            for event in chain(wanted, (None,)):
                before = upto + 1 if event is None else event.seq
                cursor = connection.execute(_READ_BLOCKS, (key, expected, before))
                while rows := cursor.fetchmany(_BLOCK):
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
        """Trials past a log position as wire maps with their present costs, and where to go on (None at the end)."""
        return self._page(_PAGE, task, after, limit, most_bytes)

    def page_before(
        self, task: str, before: int | None, limit: int, most_bytes: int
    ) -> tuple[list[dict[str, Any]], int | None]:
        """The same backwards: trials before a log position (None: from the end), newest first, and where to go on."""
        return self._page(_PAGE_BEFORE, task, _END if before is None else before, limit, most_bytes)

    def _page(
        self, query: str, task: str, start: int, limit: int, most_bytes: int
    ) -> tuple[list[dict[str, Any]], int | None]:
        entries: list[dict[str, Any]] = []
        size = 0
        with read_errors(f"read samples of task {task!r}"):
            for row in self._connection().execute(query, (self._key(task), start, limit + 1)):
                size += _ROW_BYTES + sum(_bytes(value) for value in row)
                if entries and (len(entries) == limit or size > most_bytes):
                    return entries, int(entries[-1]["seq"])
                entries.append(wire_of(row))
        return entries, None

    def check(self, task: str, upto: int) -> None:
        """Raise `StorageError` for the first trial, up to a log position, whose row is not what was stored."""
        with read_errors(f"check the rows of task {task!r}"):
            key = self._key(task)
            for after in range(0, upto, _BLOCK):  # each a read of its own: a long one would keep the log from shrinking
                for row in self._connection().execute(_READ_SPAN, (key, after, min(after + _BLOCK, upto))):
                    check_row(row)

    def load_cache(self, task: str) -> tuple[int, bytes] | None:
        """The cached bytes and their log position; None if missing or damaged."""
        with read_errors(f"read the cache of task {task!r}"):
            row = (
                self._connection()
                .execute("SELECT version, data, digest FROM cache WHERE task = ?", (self._key(task),))
                .fetchone()
            )
        return (int(row[0]), row[1]) if row and body_digest(f"cache {row[0]}", row[1]) == row[2] else None

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Within the block, this thread reads the log as of the first read."""
        connection = self._connection()
        connection.execute("BEGIN")
        try:
            yield
        finally:
            connection.execute("ROLLBACK")

    def integrity(self) -> list[str]:
        """Errors that SQLite finds in the database's pages and indexes; reads everything."""
        with read_errors("check the task log"):
            found = [str(row[0]) for row in self._connection().execute("PRAGMA integrity_check")]
        return [] if found == ["ok"] else found

    def backup(self, target: Path) -> None:
        """Copy the present log into a new file, which gets its name only once it is complete."""
        if target.exists():
            raise StorageError(f"{target} exists; choose another file")
        partial = target.with_name(f"{target.name}.{os.getpid()}.partial")  # another backup's is not ours to end
        try:
            with storage_errors(f"back up to {target}"):
                os.close(
                    os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
                )  # no link's target
                copy = sqlite3.connect(partial)
                try:
                    self._connection().backup(copy)
                    copy.execute("PRAGMA journal_mode = DELETE")  # one file, complete in itself
                finally:
                    copy.close()
            os.replace(partial, target)
        finally:
            for name in (partial.name, f"{partial.name}-journal"):
                partial.with_name(name).unlink(missing_ok=True)

    def close(self) -> None:
        """Close the connections of this thread and of those that ended; idempotent.

        One that another thread may just be reading from is left to that thread: to close it would end the process.
        """
        while self._open:
            thread, connection = self._open.pop()
            if thread is threading.current_thread() or not thread.is_alive():
                connection.close()

    def _key(self, task: str) -> int:
        row = self._connection().execute("SELECT id FROM task WHERE name = ?", (task,)).fetchone()
        if row is None:
            raise UnknownTask(f"the log holds no task {task!r}", details={"task": task})
        return int(row[0])

    def _connection(self) -> sqlite3.Connection:
        connection: sqlite3.Connection | None = getattr(self._threads, "connection", None)
        if connection is None:
            connection = self._threads.connection = connect(self.path, read_only=True)
            self._open.append((threading.current_thread(), connection))
        return connection


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
