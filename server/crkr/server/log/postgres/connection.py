"""Connections to PostgreSQL, and the meaning of its errors.

Every statement commits by itself: an open transaction of a stalled server would block the server that takes over. A
lost server, a cut link and a stalled PostgreSQL process are noticed within a few seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, final

import psycopg
from psycopg import errors
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from crkr.protocol import ShuttingDown, StorageError

__all__ = [
    "RESTORE",
    "RETRY_MS",
    "Connection",
    "connect",
    "database_errors",
    "is_away",
    "read_errors",
]

RETRY_MS: Final = 250  # pause before a request is repeated while the database is away
_DEFAULTS: Final = {
    "application_name": "crkr",
    "connect_timeout": "2",  # seconds, the least that libpq takes
    "keepalives_idle": "2",
    "keepalives_interval": "1",
    "keepalives_count": "3",
    "tcp_user_timeout": "4000",  # milliseconds without an acknowledgement of what was sent
}
# An abandoned session must not hold a lock for long. Texts are compared as bytes.
_SETTINGS: Final = "SET search_path = crkr; SET idle_in_transaction_session_timeout = '10s'; SET synchronous_commit = "
_DEADLINES: Final = "SET lock_timeout = '5s'; SET statement_timeout = '30s'"  # a commit is never cut short by them
_NO_DEADLINE: Final = "SET statement_timeout = 0"
RESTORE: Final = "; restore a backup"
_ADVICE: Final[tuple[tuple[type[psycopg.Error], str], ...]] = (
    (errors.ReadOnlySqlTransaction, "; the database takes no writes: name the primary, or let it"),
    (errors.InsufficientPrivilege, "; grant the server's role what it needs"),
    (errors.DiskFull, "; make room there"),
    (errors.UndefinedTable, RESTORE),
    (errors.UndefinedColumn, RESTORE),
    (errors.DataCorrupted, RESTORE),
    (errors.IndexCorrupted, RESTORE),
)


@final
class Connection(psycopg.Connection[Any]):
    """A connection whose statements raise `psycopg.OperationalError` without a timely answer; close it then.

    Attributes:
        patience_s: The longest wait for an answer [s]; None: no limit. TCP does not notice a stalled process, because
            its machine still acknowledges data.
    """

    patience_s: float | None = None

    def wait(self, gen: Any, interval: float = 0.1, timeout: float | None = None) -> Any:
        """As psycopg's."""
        return super().wait(gen, interval, self.patience_s if timeout is None else timeout)


def connect(url: str, patience_s: float | None = None) -> Connection:
    """A connection with the log's settings, which commits each statement; raises `psycopg.Error`.

    Args:
        url: The database.
        patience_s: As for `Connection`. With a limit, a statement waits 5 s for a lock and runs 30 s at most.
    """
    given: dict[str, Any] = dict(conninfo_to_dict(url))
    defaults = dict(_DEFAULTS)
    if "," in str(given.get("host", "")):  # with several hosts: the primary
        defaults["target_session_attrs"] = "read-write"
    connection = Connection.connect(make_conninfo(**{**defaults, **given}), autocommit=True)
    connection.patience_s = patience_s
    try:
        # A commit is acknowledged once it is on the disk, and on a synchronous standby if there is one.
        row = connection.execute("SHOW synchronous_commit").fetchone()
        kept = row[0] if row and row[0] in ("remote_apply", "on") else "on"
        connection.execute(f"{_SETTINGS}{kept}; {_NO_DEADLINE if patience_s is None else _DEADLINES}")
    except BaseException:
        connection.close()
        raise
    return connection


def is_away(error: psycopg.Error, connection: psycopg.Connection[Any] | None) -> bool:
    """Whether an error means that the database is away for now, not that it refuses something."""
    away = (
        errors.AdminShutdown,
        errors.CrashShutdown,
        errors.CannotConnectNow,
        errors.TooManyConnections,
        errors.QueryCanceled,  # past its deadline
        errors.DeadlockDetected,
        errors.LockNotAvailable,
    )
    refused = (errors.InvalidPassword, errors.InvalidAuthorizationSpecification, errors.InvalidCatalogName)
    if isinstance(error, refused):
        return False
    if isinstance(error, (*away, errors.ConnectionException)) or (connection is not None and connection.broken):
        return True
    return isinstance(error, psycopg.OperationalError) and error.sqlstate is None and not _is_refusal(str(error))


def _is_refusal(message: str) -> bool:
    """Whether another attempt to connect is useless; libpq gives no code for that."""
    return any(text in message for text in ("authentication failed", "does not exist", "no pg_hba.conf entry"))


@contextmanager
def database_errors(doing: str, connection: psycopg.Connection[Any] | None = None) -> Iterator[None]:
    """Turn database errors into `StorageError`, or `ShuttingDown` if it is away and a repeat may help.

    `UniqueViolation` passes, for an id that is stored already.
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
    """The same for reading, where an absent database is an error, and a column of the wrong type is damage."""
    try:
        with database_errors(doing):
            yield
    except ShuttingDown as error:
        raise StorageError(error.message.replace("; repeat it with the same ids", "")) from error
    except (TypeError, ValueError, LookupError) as error:
        raise StorageError(f"cannot {doing}: it holds what was never stored ({error}){RESTORE}") from error
