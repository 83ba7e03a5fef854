"""A log's PostgreSQL database, read from any thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any, Final, final

import psycopg

from crkr.protocol import StorageError
from crkr.server.log.postgres.connection import connect, is_away, read_errors
from crkr.server.log.postgres.schema import prepare
from crkr.server.log.postgres.url import printable_location

__all__ = ["PostgresDatabase"]

_ACKNOWLEDGED: Final = "SELECT coalesce(sum(last), 0) FROM task"
_SIZE: Final = """SELECT sum(pg_total_relation_size(oid)) FROM pg_class
                  WHERE relkind = 'r' AND relnamespace = 'crkr'::regnamespace"""
_STRAYS: Final = """SELECT count(*) FROM (SELECT task FROM event UNION SELECT task FROM trial
                    UNION SELECT task FROM cache UNION SELECT task FROM summary EXCEPT SELECT id FROM task) AS stray"""


@final
class PostgresDatabase:
    """A `Database` by its URL.

    Attributes:
        where: The URL without its password.
        is_log: There are tables in it.

    Raises:
        StorageError: There is no log, it is of another version, or the database cannot be reached.
    """

    def __init__(self, url: str) -> None:
        self.where: Final = printable_location(url)
        self._url = url
        self._threads = threading.local()
        self._opening = threading.Lock()
        self._open: list[tuple[threading.Thread, psycopg.Connection[Any]]] = []
        try:
            with read_errors(f"open the task log {self.where}"):
                self.is_log: Final = prepare(self._connection(), url, create=False)
            if not self.is_log:
                raise StorageError(f"there is no task log in {self.where}")
        except BaseException:
            self.close()
            raise

    @property
    def acknowledged(self) -> int:
        """Acknowledged log positions of all tasks; read before the entries, which only grow."""
        return int(self.rows(_ACKNOWLEDGED)[0][0])

    def rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        """As `Database.rows`; repeated once if the connection was lost, as after a restart."""
        connection = self._connection()
        try:
            return self._ask(connection, statement, values)
        except psycopg.Error as error:
            if getattr(self._threads, "within", False) or not is_away(error, connection):
                raise
            connection.close()
            return self._ask(self._connection(), statement, values)

    def errors(self, doing: str) -> AbstractContextManager[None]:
        """As `Database.errors`."""
        return read_errors(doing)

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """As `Database.snapshot`."""
        doing = f"read the task log {self.where}"
        with read_errors(doing):
            connection = self._connection()
            connection.execute("SET idle_in_transaction_session_timeout = 0")  # reading blocks nobody
            connection.execute("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY")
        self._threads.within = True
        try:
            yield
        finally:
            self._threads.within = False
            if not connection.broken:
                with read_errors(doing):
                    connection.execute("ROLLBACK")

    def integrity(self) -> list[str]:
        """Entries of tasks that are not listed; PostgreSQL checks its own pages, where `data_checksums` is on."""
        with read_errors("check the task log"):
            strays = self.rows(_STRAYS)[0][0]
        return [f"{strays} tasks with entries are not listed"] if strays else []

    def size(self) -> int | None:
        """Bytes of the tables; None while the database is away."""
        try:
            return int(self.rows(_SIZE)[0][0])
        except psycopg.Error:
            return None

    def close(self) -> None:
        """Close the connections of this thread and of those that ended; idempotent."""
        with self._opening:
            opened, self._open = self._open, []
        for thread, connection in opened:
            if thread is threading.current_thread() or not thread.is_alive():
                connection.close()

    def _ask(self, connection: psycopg.Connection[Any], statement: str, values: Sequence[object]) -> list[Any]:
        cursor = connection.cursor(row_factory=_rows)
        return cursor.execute(_translated(statement), values or None, binary=True).fetchall()

    def _connection(self) -> psycopg.Connection[Any]:
        connection: psycopg.Connection[Any] | None = getattr(self._threads, "connection", None)
        if connection is None or connection.closed:
            connection = self._threads.connection = connect(self._url)
            with self._opening:
                self._open = [one for one in self._open if not one[1].closed]
                self._open.append((threading.current_thread(), connection))
        return connection


@cache
def _translated(statement: str) -> Any:  # psycopg wants literals, against injection; all statements are constants
    return statement.replace("?", "%s")


def _rows(cursor: psycopg.Cursor[Any]) -> Callable[[Sequence[Any]], tuple[Any, ...]]:
    """Tuples. A worker's name is stored as bytes: a text of PostgreSQL holds no character 0."""
    names = [column.name for column in cursor.description or ()]
    if "worker" not in names:
        return tuple
    place = names.index("worker")

    def row(values: Sequence[Any]) -> tuple[Any, ...]:
        found = list(values)
        found[place] = None if found[place] is None else found[place].decode()
        return tuple(found)

    return row
