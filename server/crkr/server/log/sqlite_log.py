"""The task log in one SQLite file: one file, so that reports of all tasks share one commit and one backup."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, final
from uuid import UUID

from crkr.protocol import Conflict, StorageError, TaskSpec, Trial, id_from_wire, pack, unpack
from crkr.server.log.directory_lock import DirectoryLock
from crkr.server.log.entries import Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.rows import PAGE_COLUMNS, TRIAL_COLUMNS, body_digest, trial_of, trial_row, wire_of
from crkr.server.log.schema import FILE_NAME, connect, open_database, storage_errors

__all__ = ["SqliteLog"]

_INSERT: Final = f"INSERT INTO trial (task, {TRIAL_COLUMNS}) VALUES ({', '.join('?' * 14)})"
_FIND: Final = "SELECT seq, digest FROM trial WHERE task = ? AND id = ?"
_READ_TRIALS: Final = f"SELECT {TRIAL_COLUMNS} FROM trial WHERE task = ? AND seq > ? ORDER BY seq"
_READ_EVENTS: Final = "SELECT seq, time, kind, body, digest FROM event WHERE task = ? AND seq > ? ORDER BY seq"
_PAGE: Final = f"SELECT {PAGE_COLUMNS} FROM trial WHERE task = ? AND seq > ? ORDER BY seq LIMIT ?"
_LAST: Final = """SELECT max((SELECT coalesce(max(seq), 0) FROM trial WHERE task = :task),
                            (SELECT coalesce(max(seq), 0) FROM event WHERE task = :task))"""
_ROW_BYTES: Final = 240  # of a page entry, its vectors and info aside


@final
class SqliteLog:
    """A `TaskLog` in `directory`, which is locked against other servers.

    Raises:
        StorageError: In use, damaged, of a newer version, or not writable.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE_NAME
        self._lock = DirectoryLock(directory)
        try:
            self._writer = open_database(self.path)
        except BaseException:
            self._lock.release()
            raise
        self._writing = threading.Lock()
        self._readers = threading.local()
        self._open_readers: list[sqlite3.Connection] = []
        self._keys: dict[str, int] = {name: key for key, name in self._writer.execute("SELECT id, name FROM task")}
        self._last = {
            name: int(self._writer.execute(_LAST, {"task": key}).fetchone()[0]) for name, key in self._keys.items()
        }
        self._closed = False

    def tasks(self) -> tuple[str, ...]:
        """Names of all tasks, oldest first."""
        return tuple(self._keys)

    def last(self, task: str) -> int:
        """Log position of the task's last entry."""
        return self._last[task]

    def create(self, spec: TaskSpec) -> Event:
        """Stores a new task; its create event has seq 1."""
        with self._transaction(f"create task {spec.name!r}") as connection:
            cursor = connection.execute("INSERT INTO task (name) VALUES (?)", (spec.name,))
            key = int(cursor.lastrowid or 0)
            event = _insert_event(connection, key, 1, "create", {"spec": spec.to_dict()})
        self._keys[spec.name], self._last[spec.name] = key, 1
        return event

    def append_reports(self, reports: Sequence[PendingReport]) -> list[Stored | Conflict]:
        """Stores several reports in one transaction; a report in conflict leaves the others alone."""
        last = dict(self._last)
        with self._transaction("store trials") as connection:
            now = time.time()
            results: list[Stored | Conflict] = []
            for report in reports:
                result = self._append_report(connection, report, last[report.task], now)
                if isinstance(result, Stored) and result.fresh:
                    last[report.task] = result.fresh[-1].seq
                results.append(result)
        self._last = last
        return results

    def _append_report(
        self, connection: sqlite3.Connection, report: PendingReport, last: int, now: float
    ) -> Stored | Conflict:
        """Finds every known id first, so that a conflict stores nothing of its report."""
        key = self._keys[report.task]
        seqs: list[int] = []
        fresh: list[LoggedTrial] = []
        rows: list[tuple[Any, ...]] = []
        seen: dict[bytes, tuple[int, bytes]] = {}
        for trial in report.trials:
            digest = trial.digest()
            known = seen.get(trial.id.bytes) or connection.execute(_FIND, (key, trial.id.bytes)).fetchone()
            if known is None:
                known = (last + len(fresh) + 1, digest)
                fresh.append(LoggedTrial(known[0], now, trial))
                rows.append(trial_row(key, known[0], now, trial, digest))
            elif known[1] != digest:
                return _conflict(trial, int(known[0]))
            seen[trial.id.bytes] = (int(known[0]), digest)
            seqs.append(int(known[0]))
        connection.executemany(_INSERT, rows)
        return Stored(tuple(seqs), tuple(fresh))

    def append_event(self, task: str, kind: str, body: Mapping[str, Any]) -> Event:
        """Stores an event and brings the trials it names up to date."""
        key, seq = self._keys[task], self._last[task] + 1
        with self._transaction(f"store {kind} of task {task!r}") as connection:
            event = _insert_event(connection, key, seq, kind, body)
            if kind == "recost":
                costs = zip(body["costs"], body["ids"], strict=True)
                connection.executemany(
                    "UPDATE trial SET present_cost = ? WHERE task = ? AND id = ?",
                    [(cost, key, id_from_wire(identity).bytes) for cost, identity in costs],
                )
            elif kind == "remove":
                connection.executemany(
                    "UPDATE trial SET removed = 1 WHERE task = ? AND id = ?",
                    [(key, id_from_wire(identity).bytes) for identity in body["ids"]],
                )
        self._last[task] = seq
        return event

    def missing(self, task: str, ids: Sequence[UUID]) -> list[UUID]:
        """The ids that name no stored trial."""
        with storage_errors("look up trials"):
            reader, key = self._reader(), self._keys[task]
            return [one for one in ids if reader.execute(_FIND, (key, one.bytes)).fetchone() is None]

    def read(self, task: str, after: int = 0) -> Iterator[LoggedTrial | Event]:
        """All entries past a log position, in order; raises `StorageError` at the first that is damaged or missing."""
        with storage_errors(f"read the log of task {task!r}"):
            connection, key = self._reader(), self._keys[task]
            events = iter([_event(row) for row in connection.execute(_READ_EVENTS, (key, after))])
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

    def page(self, task: str, after: int, limit: int, most_bytes: int) -> tuple[list[dict[str, Any]], int | None]:
        """Trials past a log position as wire maps with their present costs, and where to go on (None at the end)."""
        entries: list[dict[str, Any]] = []
        size = 0
        with storage_errors(f"read samples of task {task!r}"):
            for row in self._reader().execute(_PAGE, (self._keys[task], after, limit + 1)):
                size += _ROW_BYTES + sum(len(value) for value in row if isinstance(value, bytes | str))
                if entries and (len(entries) == limit or size > most_bytes):
                    return entries, int(entries[-1]["seq"])
                entries.append(wire_of(row))
        return entries, None

    def save_cache(self, task: str, version: int, data: bytes) -> None:
        """Keeps bytes that belong to a log position, in place of the ones before."""
        with self._transaction(f"store the cache of task {task!r}") as connection:
            connection.execute(
                "INSERT OR REPLACE INTO cache (task, version, data, digest) VALUES (?, ?, ?, ?)",
                (self._keys[task], version, data, body_digest("cache", data)),
            )

    def load_cache(self, task: str) -> tuple[int, bytes] | None:
        """The bytes kept last and their log position, or None where there are none or they are damaged."""
        with storage_errors(f"read the cache of task {task!r}"):
            row = (
                self._reader()
                .execute("SELECT version, data, digest FROM cache WHERE task = ?", (self._keys[task],))
                .fetchone()
            )
        return (int(row[0]), row[1]) if row and body_digest("cache", row[1]) == row[2] else None

    def backup(self, target: Path) -> None:
        """Copies the whole log into a new file, consistently, while it is in use."""
        with storage_errors(f"back up to {target}"):
            copy = sqlite3.connect(target)
            try:
                self._reader().backup(copy, pages=1024, sleep=0.0)
            finally:
                copy.close()

    def close(self) -> None:
        """Empties the write-ahead log into the database and frees the directory; idempotent."""
        if self._closed:
            return
        self._closed = True
        try:
            for reader in self._open_readers:
                reader.close()
            with storage_errors("close the task log"):
                self._writer.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        finally:
            self._writer.close()
            self._lock.release()

    @contextmanager
    def _transaction(self, doing: str) -> Iterator[sqlite3.Connection]:
        with self._writing, storage_errors(doing):
            self._writer.execute("BEGIN IMMEDIATE")
            try:
                yield self._writer
                self._writer.execute("COMMIT")
            except BaseException:
                if self._writer.in_transaction:
                    self._writer.execute("ROLLBACK")
                raise

    def _reader(self) -> sqlite3.Connection:
        """This thread's own connection: readers see a snapshot and hold up no writer."""
        connection: sqlite3.Connection | None = getattr(self._readers, "connection", None)
        if connection is None:
            connection = connect(self.path, read_only=True)
            self._readers.connection = connection
            self._open_readers.append(connection)
        return connection


def _insert_event(connection: sqlite3.Connection, key: int, seq: int, kind: str, body: Mapping[str, Any]) -> Event:
    now, data = time.time(), pack(body)
    connection.execute(
        "INSERT INTO event (task, seq, time, kind, body, digest) VALUES (?, ?, ?, ?, ?, ?)",
        (key, seq, now, kind, data, body_digest(kind, data)),
    )
    return Event(seq, now, kind, unpack(data))


def _event(row: tuple[Any, ...]) -> Event:
    seq, now, kind, body, digest = row
    if body_digest(kind, body) != digest:
        raise StorageError(f"the {kind} event at log position {seq} does not match its digest; restore a backup")
    return Event(seq, now, kind, unpack(body))


def _follows(task: str, seq: int, before: int) -> int:
    if seq != before + 1:
        raise StorageError(f"the log of task {task!r} lacks position {before + 1}; restore a backup")
    return seq


def _conflict(trial: Trial, seq: int) -> Conflict:
    return Conflict(
        f"trial {trial.id} is stored at log position {seq} with other content; use a new id for a new trial",
        details={"id": trial.id.bytes, "seq": seq},
    )
