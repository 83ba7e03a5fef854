"""Connections to PostgreSQL, the tables there, and what errors mean.

Connections commit each statement by itself: a transaction that is left open by a server that stalls would hold up the
one that takes over. A server that is gone, or a link that is cut, is noticed within a few seconds.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final
from uuid import uuid4

import psycopg
from psycopg import errors
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from crkr.protocol import ShuttingDown, StorageError
from crkr.server.log.postgres.url import printable_location

__all__ = ["RETRY_MS", "SCHEMA_VERSION", "connect", "database_errors", "is_away", "prepare", "read_errors"]

logger = logging.getLogger(__name__)

SCHEMA_VERSION: Final = 1
RETRY_MS: Final = 250  # after which a request may be repeated while the database is away
_DEFAULTS: Final = {
    "application_name": "crkr",
    "connect_timeout": "2",  # seconds, the least that libpq takes
    "keepalives_idle": "2",
    "keepalives_interval": "1",
    "keepalives_count": "3",
    "tcp_user_timeout": "4000",  # milliseconds without an acknowledgement of what was sent
}
# A session that is left in the middle of something must not hold a lock for long. Bytes are compared, texts as well.
_SETTINGS: Final = "SET search_path = crkr; SET idle_in_transaction_session_timeout = '10s'; SET synchronous_commit = "
_DEADLINES: Final = "SET lock_timeout = '5s'; SET statement_timeout = '30s'"  # a commit is never cut short by them
_NO_DEADLINE: Final = "SET statement_timeout = 0"
_TABLES: Final = """
CREATE TABLE crkr.log (
    one boolean PRIMARY KEY DEFAULT true CHECK (one), version integer NOT NULL, id uuid NOT NULL,
    epoch bigint NOT NULL DEFAULT 0, positions bigint NOT NULL DEFAULT 0, purged bigint NOT NULL DEFAULT 0,
    beat bigint NOT NULL DEFAULT 0,
    owner uuid, address text, backend integer, backend_start timestamptz, standbys text[] NOT NULL DEFAULT '{}'
) WITH (fillfactor = 10);
CREATE TABLE crkr.task (id bigint PRIMARY KEY, name text NOT NULL UNIQUE);
CREATE TABLE crkr.event (
    task bigint NOT NULL, seq bigint NOT NULL, time double precision NOT NULL, kind text NOT NULL, body bytea NOT NULL,
    digest bytea NOT NULL, PRIMARY KEY (task, seq));
CREATE TABLE crkr.trial (
    task bigint NOT NULL, seq bigint NOT NULL, id bytea NOT NULL, time double precision NOT NULL,
    kind smallint NOT NULL, success smallint NOT NULL, cost double precision, state bytea NOT NULL,
    goal bytea NOT NULL, outcome bytea, worker bytea, model_version bigint, info bytea, digest bytea NOT NULL,
    present_cost double precision, removed smallint NOT NULL DEFAULT 0, PRIMARY KEY (task, seq));
CREATE UNIQUE INDEX trial_id ON crkr.trial (task, id);
CREATE TABLE crkr.cache (task bigint PRIMARY KEY, version bigint NOT NULL, data bytea NOT NULL, digest bytea NOT NULL);
"""
_RESTORE: Final = "; restore a backup"
_ADVICE: Final[tuple[tuple[type[psycopg.Error], str], ...]] = (
    (errors.ReadOnlySqlTransaction, "; the database takes no writes: name the primary, or let it"),
    (errors.InsufficientPrivilege, "; grant the server's role what it needs"),
    (errors.DiskFull, "; make room there"),
    (errors.UndefinedTable, _RESTORE),
    (errors.UndefinedColumn, _RESTORE),
    (errors.DataCorrupted, _RESTORE),
    (errors.IndexCorrupted, _RESTORE),
)


def connect(url: str, *, reading: bool = False) -> psycopg.Connection[Any]:
    """A connection with the log's settings, which commits each statement; raises `psycopg.Error`.

    Args:
        url: The database.
        reading: A statement may take as long as it takes; otherwise it waits 5 s for a lock and runs 30 s at most.
    """
    given: dict[str, Any] = dict(conninfo_to_dict(url))
    defaults = dict(_DEFAULTS)
    if "," in str(given.get("host", "")):  # several: the primary among them
        defaults["target_session_attrs"] = "read-write"
    connection = psycopg.connect(make_conninfo(**{**defaults, **given}), autocommit=True)
    try:
        # A commit is on the disk, and on a synchronous standby where there is one, before it is acknowledged.
        row = connection.execute("SHOW synchronous_commit").fetchone()
        kept = row[0] if row and row[0] in ("remote_apply", "on") else "on"
        connection.execute(f"{_SETTINGS}{kept}; {_NO_DEADLINE if reading else _DEADLINES}")
    except BaseException:
        connection.close()
        raise
    return connection


def is_away(error: psycopg.Error, connection: psycopg.Connection[Any] | None) -> bool:
    """Whether an error says that the database is away for now, rather than that it refuses something."""
    away = (
        errors.AdminShutdown,
        errors.CrashShutdown,
        errors.CannotConnectNow,
        errors.TooManyConnections,
        errors.QueryCanceled,  # past its deadline
        errors.LockNotAvailable,
    )
    refused = (errors.InvalidPassword, errors.InvalidAuthorizationSpecification, errors.InvalidCatalogName)
    if isinstance(error, refused):
        return False
    if isinstance(error, (*away, errors.ConnectionException)) or (connection is not None and connection.broken):
        return True
    return isinstance(error, psycopg.OperationalError) and error.sqlstate is None and not _is_refusal(str(error))


def _is_refusal(message: str) -> bool:
    """Whether a connection failed over what another attempt cannot change; libpq gives no code then."""
    return any(text in message for text in ("authentication failed", "does not exist", "no pg_hba.conf entry"))


@contextmanager
def database_errors(doing: str, connection: psycopg.Connection[Any] | None = None) -> Iterator[None]:
    """Turn the database's errors into `StorageError`, or `ShuttingDown` where it is away and a repeat may help.

    An id that is stored already stays `UniqueViolation`.
    """
    try:
        yield
    except errors.UniqueViolation:
        raise
    except psycopg.Error as error:
        said = " ".join(str(error.diag.message_primary or error).split())
        if is_away(error, connection):
            raise ShuttingDown(
                f"cannot {doing}: the database is away ({said}); repeat it with the same ids", retry_ms=RETRY_MS
            ) from error
        advice = next((advice for kind, advice in _ADVICE if isinstance(error, kind)), "")
        raise StorageError(f"cannot {doing}: {said}{advice}") from error


@contextmanager
def read_errors(doing: str) -> Iterator[None]:
    """The same for reading, where being away is an error too, and a column of the wrong type is damage."""
    try:
        with database_errors(doing):
            yield
    except ShuttingDown as error:
        raise StorageError(error.message.replace("; repeat it with the same ids", "")) from error
    except (TypeError, ValueError, LookupError) as error:
        raise StorageError(f"cannot {doing}: it holds what was never stored ({error}){_RESTORE}") from error


def prepare(connection: psycopg.Connection[Any], where: str, *, create: bool) -> bool:
    """Check the tables, or make them; returns whether there are some.

    Raises:
        StorageError: They are of another version, or some are missing.
        psycopg.Error: The database refuses it.
    """
    shown = printable_location(where)
    found = {name for (name,) in connection.execute("SELECT tablename FROM pg_tables WHERE schemaname = 'crkr'")}
    if not found and not create:
        return False
    if not found:
        try:
            with connection.transaction():
                connection.execute("CREATE SCHEMA IF NOT EXISTS crkr")
                connection.execute(_TABLES)
                connection.execute("INSERT INTO crkr.log (version, id) VALUES (%s, %s)", (SCHEMA_VERSION, uuid4()))
        except (errors.UniqueViolation, errors.DuplicateTable, errors.DuplicateSchema):  # by another server just now
            return prepare(connection, where, create=False)
        logger.info("made the tables of a task log in %s", shown)
        return True
    lacking = {"log", "task", "event", "trial", "cache"} - found
    if lacking:
        raise StorageError(f"the task log {shown} lacks its table {min(lacking)!r}{_RESTORE}")
    row = connection.execute("SELECT version FROM crkr.log").fetchone()
    if row is None:
        raise StorageError(f"the task log {shown} lacks its row in the table 'log'{_RESTORE}")
    if row[0] != SCHEMA_VERSION:
        raise StorageError(
            f"the task log {shown} has schema version {row[0]}, this crkr knows {SCHEMA_VERSION}: use a newer crkr"
        )
    return True
