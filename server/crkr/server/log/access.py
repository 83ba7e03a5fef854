"""Access to a log by its location: reads it, writes it where no server does, and copies tasks row by row."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from crkr.protocol import Conflict, StorageError, UnknownTask
from crkr.server.log.postgres.url import is_url, printable_location
from crkr.server.log.reader import LogReader
from crkr.server.log.schema import FILE_NAME, storage_errors
from crkr.server.log.sqlite_database import SqliteDatabase, publish
from crkr.server.log.sqlite_log import SqliteLog
from crkr.server.log.task_log import TaskLog

__all__ = ["copy_tasks", "copy_to_file", "database_file", "database_summary", "open_unserved", "read_log"]

_LOOK_S: Final = 0.2


def database_file(where: str | Path) -> Path:
    """The file of a data directory, or the file itself."""
    path = Path(where)
    return path if path.suffix == Path(FILE_NAME).suffix and not path.is_dir() else path / FILE_NAME


def read_log(where: str | Path) -> LogReader:
    """Open a log for reading; a server may use it at the same time.

    Raises:
        StorageError: There is no log, it is damaged, or of a newer version.
    """
    if is_url(where):
        from crkr.server.log.postgres.database import PostgresDatabase

        return LogReader(PostgresDatabase(str(where)))
    return LogReader(SqliteDatabase(database_file(where)))


def database_summary(url: str) -> str:
    """Summary of a database and the servers that own it; raises `StorageError` if it cannot be read."""
    from crkr.server.log.postgres.database import PostgresDatabase

    database = PostgresDatabase(url)
    try:
        reader = LogReader(database)
        with database.errors("look at the task log"):
            serving = [str(one) for (one,) in database.rows("SELECT address FROM server WHERE serves ORDER BY number")]
        positions = reader.positions()
        if lost := reader.lost_end():
            raise StorageError(lost)
    finally:
        database.close()
    owned = f"served at {', '.join(serving)}" if serving else "no server owns it"
    return f"{len(positions)} tasks with {sum(positions.values())} log positions; {owned}"


def copy_tasks(
    source: LogReader, target: TaskLog, names: Sequence[str] = (), done: Callable[[str, int], None] = lambda *_: None
) -> tuple[str, ...]:
    """Copy tasks, each in one transaction, as the source is at this moment.

    Args:
        source: The source; a server may use it meanwhile.
        target: The target.
        names: The tasks; none: all.
        done: Called with each copied task and its number of entries.

    Returns:
        The copied tasks.

    Raises:
        UnknownTask: The source lacks one.
        Conflict: The target has one of that name.
        StorageError: The source cannot be read, or the target cannot be written.
    """
    with source.snapshot():
        there = source.tasks()
        if unknown := [name for name in names if name not in there]:
            raise UnknownTask(f"{source.where} holds no task {unknown[0]!r}; it has: {', '.join(there) or 'none'}")
        wanted = tuple(names) or there
        if taken := [name for name in target.reads.positions() if name in wanted]:
            raise Conflict(f"{target.reads.where} holds a task {taken[0]!r} already; copy into another log")
        for name in wanted:
            done(name, target.adopt(name, *source.raw(name)))
    return wanted


def copy_to_file(source: LogReader, target: Path) -> None:
    """Copy a whole log into a new SQLite file, which gets its name only once it is complete."""
    if target.exists():
        raise StorageError(f"{target} exists; choose another file")
    try:
        with storage_errors(f"back up to {target}"):
            _write_file(source, target)
    except OSError as error:
        raise StorageError(f"cannot back up to {target}: {error.strerror}") from error


def _write_file(source: LogReader, target: Path) -> None:
    folder = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        log = SqliteLog(folder)
        try:
            copy_tasks(source, log)
        finally:
            log.close()
        with closing(sqlite3.connect(log.path)) as copy:
            copy.execute("PRAGMA journal_mode = DELETE")  # makes it a single file
        publish(log.path, target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def open_unserved(where: str) -> TaskLog:
    """Open a log for writing that no server uses; raises `StorageError` if one does."""
    if not is_url(where):
        return SqliteLog(Path(where))
    from crkr.server.log.postgres.lease import LEASE_S, Lease
    from crkr.server.log.postgres.log import PostgresLog

    lease = Lease(where)
    deadline = time.monotonic() + 2 * LEASE_S
    try:
        while (roster := lease.look()).serving or not lease.join(roster):
            if time.monotonic() > deadline:
                user = " and ".join(member.address for member in roster.serving)
                raise StorageError(f"the server at {user} uses {printable_location(where)}; stop it first")
            time.sleep(_LOOK_S)
        log = PostgresLog(where, lease, lease.take(lease.tasks()))
    except BaseException:
        lease.give_up()
        raise
    log.keep(lambda _: None)  # a write is refused if another server took the log
    return log
