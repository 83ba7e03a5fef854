"""The task log in one SQLite file, so that the reports of all tasks share one commit and one backup."""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, final

from crkr.protocol import Conflict, StorageError, TaskSpec
from crkr.server.log.acknowledged_count import Tally
from crkr.server.log.data_files import (
    LOCAL_DISK,
    check_database_files,
    cut_short,
    file_sizes,
    file_system_of,
    identities,
    identity,
    is_remote,
)
from crkr.server.log.directory_lock import DirectoryLock
from crkr.server.log.entries import DELETED, Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.journal_check import refuse_foreign_journal
from crkr.server.log.new_rows import NewRows, changed_marks, event_row, new_name
from crkr.server.log.reader import LogReader
from crkr.server.log.rows import ROW_COLUMNS, TRIAL_COLUMNS, body_digest
from crkr.server.log.schema import FILE_NAME, check_schema, connect, open_database, storage_errors
from crkr.server.log.sqlite_database import SqliteDatabase, refuse_lost_end

__all__ = ["SqliteLog"]

logger = logging.getLogger(__name__)

_INSERT: Final = f"INSERT INTO trial (task, {TRIAL_COLUMNS}) VALUES ({', '.join('?' * 14)})"
_INSERT_WHOLE: Final = f"INSERT INTO trial (task, {ROW_COLUMNS}) VALUES ({', '.join('?' * 16)})"
_FIND: Final = "SELECT seq, digest FROM trial WHERE task = ? AND id = ?"
_ROW: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND id = ?"
_TICK_NS: Final = 100_000_000  # longer than the clock tick of any file system
_CLOSE_PATIENCE_S: Final = 0.5  # for a running commit
_INSERT_EVENT: Final = "INSERT INTO event (task, seq, time, kind, body, digest) VALUES (?, ?, ?, ?, ?, ?)"
_ABANDONED: Final[list[sqlite3.Connection]] = []  # never closed, nor collected
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
            refuse_lost_end(self.path)
            self._writer = open_database(self.path)
            undo.callback(self._writer.close)
            self._files, self._where = identities(self.path), str(directory)
            self._directory: tuple[int, int, int] | None = None  # as of the last check of all names
            self._seen: tuple[tuple[int, int, int] | None, int] = None, 0  # a directory, since when it is so [ns]
            self.reads = LogReader(SqliteDatabase(self.path))
            undo.callback(self.reads.close)
            self._last = self.reads.positions()
            with storage_errors(f"list the tasks of {self.path}"):
                self._keys: dict[str, int] = dict(self._writer.execute("SELECT name, id FROM task"))
            self._positions, self._added, self._data_version = sum(self._last.values()), 0, self._read_data_version()
            self._tally = Tally(directory, self._positions)
            self._wal = os.open(f"{self.path}-wal", os.O_RDONLY)  # SQLite locks the others; closing them would unlock
            undo.callback(os.close, self._wal)
            self._unwritten, self._sizes = (str(self.path), f"{self.path}-shm"), file_sizes(self._files)
            undo.pop_all()
        self._cut: list[str] = []  # files that another program has cut short
        self._writing, self._closing, self._closed = threading.Lock(), False, False

    @property
    def where(self) -> str:
        """The file."""
        return str(self.path)

    @property
    def log_id(self) -> None:
        """None: one server at a time has the file, and clients know it by its own id."""
        return None

    def recover(self) -> list[tuple[str, list[LoggedTrial | Event]]]:
        """Nothing: a commit either happened or raised."""
        return []

    def create(self, spec: TaskSpec) -> Event:
        """Store a new task; its create event has seq 1."""
        with self._transaction(f"create task {spec.name!r}") as connection:
            key = _insert_task(connection, spec.name)
            event, row = event_row(key, 1, "create", {"spec": spec.to_dict()})
            connection.execute(_INSERT_EVENT, row)
            self._added = 1
        self._keys[spec.name], self._last[spec.name] = key, 1
        return event

    def append_reports(self, reports: Sequence[PendingReport]) -> list[Stored | Conflict]:
        """Store several reports in one transaction; a report in conflict leaves the others alone."""
        last = {report.task: self._last[report.task] for report in reports}
        with self._transaction("store trials") as connection:
            new = NewRows(last)
            results = [new.add(self._keys[report.task], report, partial(_find, connection)) for report in reports]
            connection.executemany(_INSERT, new.trials)
            self._added = len(new.trials)
        self._last.update(last)
        return results

    def append_event(self, task: str, kind: str, body: Mapping[str, Any]) -> Event:
        """Store an event and update the trials it names."""
        key, seq = self._keys[task], self._last[task] + 1
        with self._transaction(f"store {kind} of task {task!r}") as connection:
            event, row = event_row(key, seq, kind, body)
            connection.execute(_INSERT_EVENT, row)
            self._added = 1
            connection.executemany(_MARK, changed_marks(event, lambda one: _row(connection, key, one), key))
            name = new_name(event) or task
            if name != task:
                connection.execute("UPDATE task SET name = ? WHERE id = ?", (name, key))
        del self._keys[task], self._last[task]
        self._keys[name], self._last[name] = key, seq
        return event

    def purge(self) -> list[str]:
        """Remove deleted tasks from the log; returns the names that they had there."""
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
            self._sizes = {}  # the next commit may shrink the database
        return gone

    def adopt(self, task: str, events: Iterable[tuple[Any, ...]], trials: Iterable[tuple[Any, ...]]) -> int:
        """Store a task's rows of another log unchanged, in one transaction; returns their number."""
        with self._transaction(f"copy task {task!r}") as connection:
            key = _insert_task(connection, task)
            for statement, rows in ((_INSERT_EVENT, events), (_INSERT_WHOLE, trials)):
                self._added += connection.executemany(statement, ((key, *row) for row in rows)).rowcount
            added = self._added
        self._keys[task], self._last[task] = key, added
        return added

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

    def sizes(self) -> tuple[int, int]:
        """Bytes of the log's files, and those free on its disk."""
        stored = free = 0
        for path in self.path.parent.glob("*.sqlite3*"):
            with suppress(FileNotFoundError):  # a backup in progress, or SQLite's own file at the end
                stored += path.stat().st_size
        with suppress(OSError):  # moved away: no room
            disk = os.statvfs(self.path.parent)
            free = disk.f_bavail * disk.f_frsize
        return stored, free

    def close(self) -> None:
        """Empty the write-ahead log into the database and unlock the directory; idempotent.

        Waits for a running commit. One that outlasts the patience closes the log when it ends, and this call raises
        `StorageError`.
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
            if not self._cut:
                with closing(self._writer) as writer, storage_errors("close the task log"):
                    writer.execute(f"PRAGMA busy_timeout = {int(1e3 * _CLOSE_PATIENCE_S)}")  # with who still reads
                    writer.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        finally:
            os.close(self._wal)
            self._tally.close()
            self._lock.release()

    @contextmanager
    def _transaction(self, doing: str) -> Iterator[sqlite3.Connection]:
        with self._writing, storage_errors(doing):
            if self._closing:
                raise StorageError(f"cannot {doing}: the task log is closed")
            self._refuse_moved_files(doing)
            self._refuse_cut_files(doing)
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
        """Raise `StorageError` if a file of the log has lost its name, as SQLite's writes to it would be lost.

        The directory's time of change covers all its names, but two changes within a clock tick share a time. So an
        unchanged directory is trusted only if the names were checked more than a tick after its change.
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
            with suppress(sqlite3.Error):  # brings the lost file's content into the database
                self._writer.execute("PRAGMA wal_checkpoint(FULL)")
        raise StorageError(
            f"cannot {doing}: the task log {moved[0]} was moved, removed or replaced while the server runs; put it "
            "back, or restart the server"
        )

    def _refuse_cut_files(self, doing: str) -> None:
        """Raise `StorageError` if another program cut a file short, since the next commits would make that worse.

        Another program's checkpoint or VACUUM makes files shorter too, and leaves the log whole.
        """
        sizes = file_sizes(self._unwritten)
        # After a stat, a file's next write takes a new time of change, which takes a fifth of a commit.
        sizes[f"{self.path}-wal"] = os.lseek(self._wal, 0, os.SEEK_END)
        cut = cut_short(self._sizes, sizes)
        self._sizes = sizes
        if not self._cut and cut and not self._is_whole(cut):
            self._cut = cut
            _ABANDONED.append(self._writer)  # its end would bring what is left of the write-ahead log into the database
        if self._cut:
            raise StorageError(
                f"cannot {doing}: the task log {self._cut[0]} was cut short while the server runs; keep a copy of its "
                "directory, restart the server, and where it is refused restore a backup"
            )

    def _is_whole(self, cut: Sequence[str]) -> bool:
        """Whether a fresh look finds all entries."""
        if f"{self.path}-shm" in cut:  # mapped: reading it would end the process
            return False
        try:
            with closing(LogReader(SqliteDatabase(self.path))) as fresh:
                return fresh.positions() == self._last and not (str(self.path) in cut and fresh.integrity())
        except StorageError:
            return False

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
        """Close after the last commit; a failure is only logged, as the commit succeeded."""
        if self._closing:
            try:
                self._end()
            except StorageError as error:
                logger.warning("the task log was not closed cleanly: %s", error.message)


def _play_back(path: Path) -> None:
    """Let SQLite roll back an interrupted change, as it does before its first read."""
    with storage_errors(f"undo what was interrupted in the task log {path}"):
        connection = connect(path)
        try:
            connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        finally:
            connection.close()


def _insert_task(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute("INSERT INTO task (name) VALUES (?)", (name,)).lastrowid or 0)


def _find(connection: sqlite3.Connection, key: int, identity: bytes) -> tuple[int, bytes] | None:
    row: tuple[int, bytes] | None = connection.execute(_FIND, (key, identity)).fetchone()
    return row


def _row(connection: sqlite3.Connection, key: int, identity: bytes) -> tuple[Any, ...] | None:
    row: tuple[Any, ...] | None = connection.execute(_ROW, (key, identity)).fetchone()
    return row
