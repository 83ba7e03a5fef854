"""The task log in one SQLite file, so that the reports of all tasks share one commit and one backup."""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, final

from crkr.protocol import Conflict, StorageError, TaskSpec, Trial, id_from_wire, pack, unpack
from crkr.server.log.acknowledged_count import TALLY_NAME, Tally, lost_end, read_tally
from crkr.server.log.data_files import LOCAL_DISK, check_database_files, file_system_of, identities, identity, is_remote
from crkr.server.log.directory_lock import DirectoryLock
from crkr.server.log.entries import DELETED, Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.journal_check import refuse_foreign_journal
from crkr.server.log.rows import DIGEST_BYTES, ROW_COLUMNS, TRIAL_COLUMNS, body_digest, changed_digest, trial_row
from crkr.server.log.schema import FILE_NAME, check_schema, connect, open_database, storage_errors
from crkr.server.log.sqlite_reader import SqliteReader

__all__ = ["SqliteLog"]

logger = logging.getLogger(__name__)

_INSERT: Final = f"INSERT INTO trial (task, {TRIAL_COLUMNS}) VALUES ({', '.join('?' * 14)})"
_FIND: Final = "SELECT seq, digest FROM trial WHERE task = ? AND id = ?"
_ROW: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND id = ?"
_TICK_NS: Final = 100_000_000  # longer than any file system's clock takes for a step
_CLOSE_PATIENCE_S: Final = 0.5  # with a commit that is under way
_MARK: Final = "UPDATE trial SET present_cost = ?, removed = ?, digest = ? WHERE task = ? AND id = ?"


@final
class SqliteLog:
    """A `TaskLog` in `directory`, which is locked against other servers.

    Raises:
        StorageError: In use, damaged, shorter than what was acknowledged, of a newer version, or not writable.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE_NAME
        with ExitStack() as undo:
            self._lock = DirectoryLock(directory)
            undo.callback(self._lock.release)
            if is_remote(kind := file_system_of(directory)):
                logger.warning("data directory %s is on %s, whose locks may fail; %s", directory, kind, LOCAL_DISK)
            check_database_files(self.path, writing=True)
            if refuse_foreign_journal(self.path):
                _play_back(self.path)
            _refuse_what_lost_its_end(self.path)
            self._writer = open_database(self.path)
            undo.callback(self._writer.close)
            self._files = identities(self.path)
            self._where = str(directory)
            self._directory: tuple[int, int, int] | None = None  # as it was when all names were looked at
            self._seen: tuple[tuple[int, int, int] | None, int] = None, 0  # a directory, and since when it is so [ns]
            self.reads = SqliteReader(self.path)
            undo.callback(self.reads.close)
            self._last = self.reads.positions()
            with storage_errors(f"list the tasks of {self.path}"):
                self._keys: dict[str, int] = dict(self._writer.execute("SELECT name, id FROM task"))
            self._data_version = self._read_data_version()
            self._positions, self._added = sum(self._last.values()), 0
            self._tally = Tally(directory, self._positions)
            undo.pop_all()
        self._writing = threading.Lock()
        self._closing = self._closed = False

    def create(self, spec: TaskSpec) -> Event:
        """Store a new task; its create event has seq 1."""
        with self._transaction(f"create task {spec.name!r}") as connection:
            cursor = connection.execute("INSERT INTO task (name) VALUES (?)", (spec.name,))
            key = int(cursor.lastrowid or 0)
            event = _insert_event(connection, key, 1, "create", {"spec": spec.to_dict()})
            self._added += 1
        self._keys[spec.name], self._last[spec.name] = key, 1
        return event

    def append_reports(self, reports: Sequence[PendingReport]) -> list[Stored | Conflict]:
        """Store several reports in one transaction; a report in conflict leaves the others alone."""
        last = {report.task: self._last[report.task] for report in reports}
        with self._transaction("store trials") as connection:
            now = time.time()
            results: list[Stored | Conflict] = []
            for report in reports:
                result = self._append_report(connection, report, last[report.task], now)
                if isinstance(result, Stored) and result.fresh:
                    last[report.task] = result.fresh[-1].seq
                    self._added += len(result.fresh)
                results.append(result)
        self._last.update(last)
        return results

    def _append_report(
        self, connection: sqlite3.Connection, report: PendingReport, last: int, now: float
    ) -> Stored | Conflict:
        """Look up every id before storing, so that a report in conflict stores nothing."""
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
            elif known[1][:DIGEST_BYTES] != digest:
                return _conflict(trial, int(known[0]))
            seen[trial.id.bytes] = (int(known[0]), digest)
            seqs.append(int(known[0]))
        connection.executemany(_INSERT, rows)
        return Stored(tuple(seqs), tuple(fresh))

    def append_event(self, task: str, kind: str, body: Mapping[str, Any]) -> Event:
        """Store an event and update the trials it names."""
        key, seq = self._keys[task], self._last[task] + 1
        with self._transaction(f"store {kind} of task {task!r}") as connection:
            event = _insert_event(connection, key, seq, kind, body)
            self._added += 1
            if kind == "recost":
                for identity, cost in zip(body["ids"], body["costs"], strict=True):
                    _mark(connection, key, id_from_wire(identity).bytes, cost=cost + 0.0)  # SQLite drops -0.0's sign
            elif kind == "remove":
                for identity in body["ids"]:
                    _mark(connection, key, id_from_wire(identity).bytes, removed=True)
            elif kind in ("rename", "delete"):
                connection.execute("UPDATE task SET name = ? WHERE id = ?", (body["name"], key))
        name = str(body["name"]) if kind in ("rename", "delete") else task
        del self._keys[task], self._last[task]
        self._keys[name], self._last[name] = key, seq
        return event

    def purge(self) -> list[str]:
        """Remove deleted tasks for good; returns the names that they had in the log."""
        gone = [name for name in self._last if name.startswith(DELETED)]
        left = self._positions - sum(self._last[name] for name in gone)
        with self._transaction("purge the deleted tasks") as connection:
            for name in gone:
                for table, column in (("trial", "task"), ("event", "task"), ("cache", "task"), ("task", "id")):
                    connection.execute(f"DELETE FROM {table} WHERE {column} = ?", (self._keys[name],))
            self._tally.note(left)  # first, so that it never runs ahead of the log
            self._positions = left
        for name in gone:
            del self._keys[name], self._last[name]
        if gone:
            with self._writing, storage_errors("shrink the task log"):
                self._writer.execute("VACUUM")
        return gone

    def save_cache(self, task: str, version: int, data: bytes) -> None:
        """Cache bytes that belong to a log position, replacing earlier ones."""
        key = self._keys.get(task)
        if key is None:  # renamed or deleted just now
            return
        with self._transaction(f"store the cache of task {task!r}") as connection:
            connection.execute(
                "INSERT OR REPLACE INTO cache (task, version, data, digest) VALUES (?, ?, ?, ?)",
                (key, version, data, body_digest(f"cache {version}", data)),
            )

    def close(self) -> None:
        """Empty the write-ahead log into the database and unlock the directory; idempotent.

        A running commit is waited for. One that outlasts the patience closes the log itself when it ends, and this call
        raises `StorageError`.
        """
        self._closing = True
        if not self._writing.acquire(timeout=_CLOSE_PATIENCE_S):
            raise StorageError(f"a commit to {self.path} takes longer than {_CLOSE_PATIENCE_S} s; it ends by itself")
        try:
            self._end()
        finally:
            self._writing.release()

    def _end(self) -> None:
        """Close everything. The caller holds the writing lock: SQLite must not be closed under a statement."""
        if self._closed:
            return
        self._closed = True
        try:
            self.reads.close()
            with storage_errors("close the task log"):
                self._writer.execute(f"PRAGMA busy_timeout = {int(1e3 * _CLOSE_PATIENCE_S)}")  # with who still reads
                self._writer.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        finally:
            self._writer.close()
            self._tally.close()
            self._lock.release()

    @contextmanager
    def _transaction(self, doing: str) -> Iterator[sqlite3.Connection]:
        with self._writing, storage_errors(doing):
            if self._closing:
                raise StorageError(f"cannot {doing}: the task log is closed")
            self._refuse_moved_files(doing)
            self._writer.execute("BEGIN IMMEDIATE")
            self._added = 0
            try:
                self._refuse_changes_of_others(doing)
                yield self._writer
                self._writer.execute("COMMIT")
                self._positions += self._added
                self._tally.note(self._positions)
            except BaseException:
                if self._writer.in_transaction:
                    self._writer.execute("ROLLBACK")
                raise
            finally:
                self._end_if_closing()

    def _refuse_moved_files(self, doing: str) -> None:
        """Raise `StorageError` if a file of the log has lost its name: what SQLite writes to it would be lost.

        The directory's time of change covers all names in it, but two changes in one tick of the clock share a time.
        So an unchanged directory is trusted only if the names were last checked more than a tick after its change.
        """
        directory, now = self._look_at_directory(), time.monotonic_ns()
        if directory is not None and directory == self._directory:
            return
        if directory != self._seen[0]:
            self._seen = directory, now
        moved = [name for name, which in self._files.items() if identity(name) != which]
        if not moved:
            self._lock.check()
            self._directory = directory if now - self._seen[1] > _TICK_NS else None
            return
        if str(self.path) not in moved:
            with suppress(sqlite3.Error):  # what only the lost file holds is brought into the database
                self._writer.execute("PRAGMA wal_checkpoint(FULL)")
        raise StorageError(
            f"cannot {doing}: the task log {moved[0]} was moved, removed or replaced while the server runs; put it "
            "back, or restart the server"
        )

    def _look_at_directory(self) -> tuple[int, int, int] | None:
        """The directory's device, inode and last change of a name [ns]; None if it is gone."""
        try:
            found = os.stat(self._where)
        except OSError:
            return None
        return found.st_dev, found.st_ino, found.st_mtime_ns

    def _refuse_changes_of_others(self, doing: str) -> None:
        """Raise `StorageError` if another process changed the entries; SQLite counts its writes in `data_version`."""
        version = self._read_data_version()
        if version == self._data_version:
            return
        check_schema(self._writer, self.path)
        if self.reads.positions() != self._last:
            raise StorageError(
                f"cannot {doing}: another program added to or removed from the task log {self.path} while the server "
                "runs; restart the server"
            )
        logger.warning("another program wrote to %s while the server runs; the entries are as they were", self.path)
        self._data_version = version

    def _read_data_version(self) -> int:
        return int(self._writer.execute("PRAGMA data_version").fetchone()[0])

    def _end_if_closing(self) -> None:
        """Close after the last commit; a failure to close is logged, as the commit itself succeeded."""
        if self._closing:
            try:
                self._end()
            except StorageError as error:
                logger.warning("the task log was not closed cleanly: %s", error.message)


def _play_back(path: Path) -> None:
    """Let SQLite roll back an interrupted change, which it does before its first read."""
    with storage_errors(f"undo what was interrupted in the task log {path}"):
        connection = connect(path)
        try:
            connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        finally:
            connection.close()


def _refuse_what_lost_its_end(path: Path) -> None:
    """Raise `StorageError` if acknowledged entries are missing, before SQLite may discard what it cannot read."""
    acknowledged, held = read_tally(path.parent), 0
    if path.is_file() and path.stat().st_size:
        reader = SqliteReader(path)
        try:
            held = sum(reader.positions().values())
        finally:
            reader.close()
    if held < acknowledged:
        raise StorageError(
            f"{lost_end(path, held, acknowledged)}; restore a backup into an empty directory, or delete "
            f"{path.parent / TALLY_NAME} to go on with what is there"
        )


def _insert_event(connection: sqlite3.Connection, key: int, seq: int, kind: str, body: Mapping[str, Any]) -> Event:
    now, data = time.time(), pack(body)
    connection.execute(
        "INSERT INTO event (task, seq, time, kind, body, digest) VALUES (?, ?, ?, ?, ?, ?)",
        (key, seq, now, kind, data, body_digest(kind, data)),
    )
    return Event(seq, now, kind, unpack(data, depth=None))


def _mark(
    connection: sqlite3.Connection, key: int, identity: bytes, *, cost: float | None = None, removed: bool = False
) -> None:
    """Set a trial's present cost, or mark it as removed; the other of the two stays."""
    row = connection.execute(_ROW, (key, identity)).fetchone()
    if row is not None:
        cost, removed = row[13] if cost is None else cost, removed or bool(row[14])
        connection.execute(_MARK, (cost, removed, changed_digest(row, cost, removed), key, identity))


def _conflict(trial: Trial, seq: int) -> Conflict:
    return Conflict(
        f"trial {trial.id} is stored at log position {seq} with other content; use a new id for a new trial",
        details={"id": trial.id.bytes, "seq": seq},
    )
