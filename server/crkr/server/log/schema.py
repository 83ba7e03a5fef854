"""The tables of the log's database, and the check of them before it is opened."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Final

from crkr.protocol import StorageError
from crkr.server.log.data_files import LOCAL_DISK, check_database_files, on_file_system

__all__ = [
    "FILE_NAME",
    "SCHEMA_VERSION",
    "check_schema",
    "check_version",
    "connect",
    "open_database",
    "read_errors",
    "storage_errors",
]

FILE_NAME: Final = "crkr.sqlite3"
# 2: a digest covers the whole row; version 1 rows are read unchanged. 3: `success` holds `learn` too.
SCHEMA_VERSION: Final = 3
APPLICATION_ID: Final = 0x63726B72  # "crkr"; `file` and SQLite tools show it
BUSY_TIMEOUT_S: Final = 5.0

# A trial's row keeps what was reported; `present_cost` and `removed` follow from later events and spare readers the
# replay. Clustered by (task, seq), so that a replay is one sequential pass.
TABLES: Final = """
CREATE TABLE task (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE event (
    task INTEGER NOT NULL, seq INTEGER NOT NULL, time REAL NOT NULL, kind TEXT NOT NULL, body BLOB NOT NULL,
    digest BLOB NOT NULL, PRIMARY KEY (task, seq)) WITHOUT ROWID;
CREATE TABLE trial (
    task INTEGER NOT NULL, seq INTEGER NOT NULL, id BLOB NOT NULL, time REAL NOT NULL, kind INTEGER NOT NULL,
    success INTEGER NOT NULL, cost REAL, state BLOB NOT NULL, goal BLOB NOT NULL, outcome BLOB, worker TEXT,
    model_version INTEGER, info BLOB, digest BLOB NOT NULL, present_cost REAL, removed INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (task, seq)) WITHOUT ROWID;
CREATE UNIQUE INDEX trial_id ON trial (task, id);
"""
# Makes a restart quick; may be dropped at any time, as the log alone is the truth.
CACHE: Final = """
CREATE TABLE IF NOT EXISTS cache (task INTEGER PRIMARY KEY, version INTEGER NOT NULL, data BLOB NOT NULL,
    digest BLOB NOT NULL)
"""

_RESTORE: Final = "somebody changed it; restore a backup"

# The statements are right, so an error in one means that the tables were changed.
_DAMAGED: Final = ("SQLITE_CORRUPT", "SQLITE_CORRUPT_INDEX", "SQLITE_NOTADB", "SQLITE_ERROR")
# SQLite's errors on a file system without locks or shared memory.
_UNLOCKABLE: Final = ("SQLITE_IOERR_LOCK", "SQLITE_IOERR_RDLOCK", "SQLITE_IOERR_UNLOCK", "SQLITE_NOLFS")
_UNLOCKABLE_STARTS: Final = ("SQLITE_IOERR_SHM", "SQLITE_PROTOCOL")
# Statistics that ANALYZE leaves for the query planner; they change no answer.
_STATISTICS: Final = {
    "sqlite_stat1": "CREATE TABLE sqlite_stat1(tbl,idx,stat)",
    "sqlite_stat4": "CREATE TABLE sqlite_stat4(tbl,idx,neq,nlt,ndlt,sample)",
}


@contextmanager
def storage_errors(doing: str) -> Iterator[None]:
    """Turn SQLite's errors into `StorageError`, which names the action."""
    try:
        yield
    except sqlite3.Error as error:
        name = str(getattr(error, "sqlite_errorname", ""))
        undecodable = not name and isinstance(error, sqlite3.OperationalError)  # text that is not valid UTF-8
        advice = "; restore a backup" if undecodable or name in _DAMAGED else ""
        if name == "SQLITE_READONLY_ROLLBACK":
            advice = "; a server that starts on it undoes what was interrupted"
        if name in _UNLOCKABLE or name.startswith(_UNLOCKABLE_STARTS):
            advice = f"; its file system may lack locks or shared memory: {LOCAL_DISK}"
        raise StorageError(f"cannot {doing}: {error}{name and f' ({name})'}{advice}") from error


@contextmanager
def read_errors(doing: str) -> Iterator[None]:
    """The same for reading, where a column of the wrong type is damage too."""
    try:
        with storage_errors(doing):
            yield
    except (TypeError, ValueError, LookupError) as error:
        raise StorageError(f"cannot {doing}: it holds what was never stored ({error}); restore a backup") from error


def connect(path: Path, *, read_only: bool = False) -> sqlite3.Connection:
    """A connection with the log's settings, without automatic transactions.

    Raises:
        StorageError: The database or a file beside it is no plain file.
    """
    check_database_files(path)
    mode = "ro" if read_only else "rwc"
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True,
        timeout=BUSY_TIMEOUT_S,
        isolation_level=None,
        check_same_thread=False,
    )
    connection.execute("PRAGMA cache_size = -65536")  # 64 MiB keeps the id index of a million trials in memory
    connection.execute("PRAGMA trusted_schema = OFF")  # an attacker's database must not run functions with side effects
    connection.execute("PRAGMA cell_size_check = ON")
    if hasattr(connection, "setconfig"):  # from Python 3.12
        connection.setconfig(getattr(sqlite3, "SQLITE_DBCONFIG_DEFENSIVE"))  # noqa: B009  # 3.11's stub lacks it
    return connection


def open_database(path: Path) -> sqlite3.Connection:
    """Open the log for writing, creating it if missing.

    Raises:
        StorageError: It is damaged, of a newer version, not a log, or cannot be written.
    """
    with read_errors(f"open the task log {path}"):
        connection = connect(path)
        try:
            _prepare(connection, path)
        except BaseException:
            connection.close()
            raise
        return connection


def check_version(connection: sqlite3.Connection, path: Path) -> bool:
    """Whether there is a log.

    Raises:
        StorageError: The database is another program's, of a newer version, or has other tables.
    """
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    application = int(connection.execute("PRAGMA application_id").fetchone()[0])
    tables = int(connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0])
    if tables and application != APPLICATION_ID:
        raise StorageError(f"{path} is a database of another program; choose another --data")
    if version > SCHEMA_VERSION:
        raise StorageError(
            f"the task log {path} has schema version {version}, this crkr knows {SCHEMA_VERSION}: use a newer crkr"
        )
    if tables:
        check_schema(connection, path)
    return tables > 0


def check_schema(connection: sqlite3.Connection, path: Path) -> None:
    """Compare tables and indexes with crkr's own, before anything is read.

    A trigger could change acknowledged rows, and a view instead of a table could be endless.

    Raises:
        StorageError: One is missing, changed, or not crkr's. Only the cache may be missing.
    """
    found = _objects(connection)
    for (kind, name), (_, definition) in found.items():
        if (kind, name) not in _expected() and (kind, _STATISTICS.get(name)) != ("table", definition):
            raise StorageError(f"the task log {path} holds a {kind} {name!r}, which crkr does not make; {_RESTORE}")
    for (kind, name), made in _expected().items():
        if (kind, name) not in found and name != "cache":
            raise StorageError(f"the task log {path} lacks its {kind} {name!r}; restore a backup")
        if found.get((kind, name), made) != made:
            raise StorageError(f"the {kind} {name!r} of the task log {path} is not as crkr makes it; {_RESTORE}")


def _objects(connection: sqlite3.Connection) -> dict[tuple[str, str], tuple[str, str]]:
    """(type, name) -> the table it belongs to, and its definition with single spaces."""
    rows = connection.execute("SELECT type, name, tbl_name, coalesce(sql, '') FROM sqlite_master")
    return {(str(kind), str(name)): (str(table), " ".join(str(sql).split())) for kind, name, table, sql in rows}


@cache
def _expected() -> dict[tuple[str, str], tuple[str, str]]:
    """The schema as SQLite stores it for our statements."""
    connection = sqlite3.connect(":memory:")
    try:
        connection.executescript(TABLES + CACHE)
        return _objects(connection)
    finally:
        connection.close()


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    exists = check_version(connection, path)
    mode = connection.execute("PRAGMA journal_mode = WAL").fetchone()[0]
    if mode != "wal":
        raise StorageError(
            f"the task log {path} cannot have a write-ahead log there{on_file_system(path)}, which takes memory that "
            f"processes share; {LOCAL_DISK}"
        )
    connection.execute("PRAGMA synchronous = FULL")
    if not exists:
        connection.executescript(
            f"BEGIN IMMEDIATE; {TABLES} PRAGMA application_id = {APPLICATION_ID};"
            f"PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;"
        )
    connection.execute("BEGIN IMMEDIATE")  # on a full or read-only disk, fail here, not at the first report
    connection.execute(CACHE)
    if connection.execute("PRAGMA user_version").fetchone()[0] != SCHEMA_VERSION:
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")  # an older crkr could not read new rows
    connection.execute("COMMIT")
