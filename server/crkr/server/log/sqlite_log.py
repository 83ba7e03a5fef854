"""The task log in one SQLite file: one file, so that reports of all tasks share one commit and one backup."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, final

from crkr.protocol import Conflict, TaskSpec, Trial, id_from_wire, pack, unpack
from crkr.server.log.directory_lock import DirectoryLock
from crkr.server.log.entries import Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.rows import TRIAL_COLUMNS, body_digest, trial_row
from crkr.server.log.schema import FILE_NAME, open_database, storage_errors
from crkr.server.log.sqlite_reader import SqliteReader

__all__ = ["SqliteLog"]

_INSERT: Final = f"INSERT INTO trial (task, {TRIAL_COLUMNS}) VALUES ({', '.join('?' * 14)})"
_FIND: Final = "SELECT seq, digest FROM trial WHERE task = ? AND id = ?"


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
            self.reads = SqliteReader(self.path)
            with storage_errors("list the tasks"):
                self._keys: dict[str, int] = {
                    name: key for key, name in self._writer.execute("SELECT id, name FROM task")
                }
            self._last = {name: self.reads.last(name) for name in self._keys}
        except BaseException:
            self._lock.release()
            raise
        self._writing = threading.Lock()
        self._closed = False

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

    def save_cache(self, task: str, version: int, data: bytes) -> None:
        """Keeps bytes that belong to a log position, in place of the ones before."""
        with self._transaction(f"store the cache of task {task!r}") as connection:
            connection.execute(
                "INSERT OR REPLACE INTO cache (task, version, data, digest) VALUES (?, ?, ?, ?)",
                (self._keys[task], version, data, body_digest("cache", data)),
            )

    def close(self) -> None:
        """Empties the write-ahead log into the database and frees the directory; idempotent."""
        if self._closed:
            return
        self._closed = True
        try:
            self.reads.close()
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


def _insert_event(connection: sqlite3.Connection, key: int, seq: int, kind: str, body: Mapping[str, Any]) -> Event:
    now, data = time.time(), pack(body)
    connection.execute(
        "INSERT INTO event (task, seq, time, kind, body, digest) VALUES (?, ?, ?, ?, ?, ?)",
        (key, seq, now, kind, data, body_digest(kind, data)),
    )
    return Event(seq, now, kind, unpack(data))


def _conflict(trial: Trial, seq: int) -> Conflict:
    return Conflict(
        f"trial {trial.id} is stored at log position {seq} with other content; use a new id for a new trial",
        details={"id": trial.id.bytes, "seq": seq},
    )
