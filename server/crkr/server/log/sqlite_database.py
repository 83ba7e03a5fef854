"""A log's SQLite file, read from any thread."""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import Any, Final, final

from crkr.protocol import StorageError
from crkr.server.log.acknowledged_count import TALLY_NAME, lost_end, read_tally
from crkr.server.log.data_files import check_database_files
from crkr.server.log.journal_check import refuse_foreign_wal
from crkr.server.log.reader import LogReader
from crkr.server.log.schema import check_version, connect, read_errors, storage_errors

__all__ = ["SqliteDatabase", "publish", "refuse_lost_end"]


@final
class SqliteDatabase:
    """A `Database` in one file.

    Attributes:
        where: The file.
        is_log: There are tables in it.
        acknowledged: Acknowledged log positions, by the file beside it.

    Raises:
        StorageError: There is no log, it is damaged, or of a newer version.
    """

    def __init__(self, path: Path) -> None:
        check_database_files(path)
        if not path.is_file() or not path.stat().st_size:  # beside an empty database SQLite deletes the write-ahead log
            raise StorageError(f"there is no task log {path}")
        self._path = path
        self.where: Final = str(path)
        self.acknowledged: Final = read_tally(path.parent)  # before the log, which a server may extend meanwhile
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

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """As `Database.rows`."""
        return self._connection().execute(statement, values).fetchall()

    def errors(self, doing: str) -> AbstractContextManager[None]:
        """As `Database.errors`."""
        return read_errors(doing)

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """As `Database.snapshot`."""
        connection = self._connection()
        connection.execute("BEGIN")
        try:
            yield
        finally:
            connection.execute("ROLLBACK")

    def integrity(self) -> list[str]:
        """Errors that SQLite finds in pages and indexes; reads everything."""
        with read_errors("check the task log"):
            found = [str(row[0]) for row in self.rows("PRAGMA integrity_check")]
        return [] if found == ["ok"] else found

    def backup(self, target: Path) -> None:
        """Copy the current log into a new file, which gets its name only once it is complete."""
        if target.exists():
            raise StorageError(f"{target} exists; choose another file")
        partial = target.with_name(f"{target.name}.{os.getpid()}.partial")  # may be another backup's
        try:
            with storage_errors(f"back up to {target}"):
                os.close(
                    os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
                )  # no link's target
                copy = sqlite3.connect(partial)
                try:
                    self._connection().backup(copy)
                    copy.execute("PRAGMA journal_mode = DELETE")  # makes it a single file
                finally:
                    copy.close()
            publish(partial, target)
        finally:
            for name in (partial.name, f"{partial.name}-journal"):
                partial.with_name(name).unlink(missing_ok=True)

    def close(self) -> None:
        """Close the connections of this thread and of those that ended; idempotent.

        A connection that another thread may be reading from is left to that thread: closing it would crash the process.
        """
        while self._open:
            thread, connection = self._open.pop()
            if thread is threading.current_thread() or not thread.is_alive():
                connection.close()

    def _connection(self) -> sqlite3.Connection:
        connection: sqlite3.Connection | None = getattr(self._threads, "connection", None)
        if connection is None:
            connection = self._threads.connection = connect(self._path, read_only=True)
            self._open.append((threading.current_thread(), connection))
        return connection


def publish(complete: Path, target: Path) -> None:
    """Give a complete file its name, in the same folder, also on the disk.

    Raises:
        StorageError: Another file got that name meanwhile; it stays.
    """
    try:
        os.link(complete, target)
        complete.unlink()
    except FileExistsError as error:
        raise StorageError(f"{target} exists; choose another file") from error
    except OSError:  # a file system without links
        os.rename(complete, target)
    folder = os.open(target.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def refuse_lost_end(path: Path) -> None:
    """Raise `StorageError` if acknowledged entries are missing, before SQLite discards what it cannot read."""
    if path.is_file() and path.stat().st_size:
        with closing(LogReader(SqliteDatabase(path))) as reader:
            lost = reader.lost_end()
    else:
        acknowledged = read_tally(path.parent)
        lost = lost_end(str(path), 0, acknowledged) if acknowledged else ""
    if lost:
        raise StorageError(
            f"{lost}; restore a backup into an empty directory, or delete {path.parent / TALLY_NAME} to go on with "
            "what is there"
        )
