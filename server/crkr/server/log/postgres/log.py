"""The task log in PostgreSQL, written by the server that owns it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, final
from uuid import UUID

import psycopg
from psycopg import errors, sql

from crkr.protocol import Conflict, ShuttingDown, StorageError, TaskSpec
from crkr.server.log.entries import DELETED, Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.new_rows import NewRows, changed_marks, event_row, new_name
from crkr.server.log.postgres.connection import RETRY_MS, connect, database_errors
from crkr.server.log.postgres.database import PostgresDatabase
from crkr.server.log.postgres.lease import Lease, Ownership
from crkr.server.log.reader import LogReader
from crkr.server.log.rows import ROW_COLUMNS, TRIAL_COLUMNS, body_digest

__all__ = ["PostgresLog"]

logger = logging.getLogger(__name__)

_CLOSE_PATIENCE_S: Final = 0.5  # with a commit that is under way
_EVENT_COLUMNS: Final = "task, seq, time, kind, body, digest"
_TYPES: Final = {
    "task": "bigint",
    "seq": "bigint",
    "time": "double precision",
    "kind": "smallint",
    "success": "smallint",
    "cost": "double precision",
    "model_version": "bigint",
    "present_cost": "double precision",
    "removed": "smallint",
}
# The first part of each write: it finds no row where another server took the log, or added to it. Whatever else the
# statement does depends on that row, so that all of it happens or nothing, in one commit and one round trip.
_FENCE: Final = """WITH fence AS (UPDATE log SET positions = positions + %b WHERE epoch = %b AND positions = %b
                                  RETURNING one)"""


def _arrays(columns: str, types: Mapping[str, str]) -> str:
    return ", ".join(f"%b::{types.get(column, 'bytea')}[]" for column in columns.split(", "))


def _insert(table: str, columns: str, types: Mapping[str, str]) -> str:
    return f"INSERT INTO {table} ({columns}) SELECT new.* FROM fence, unnest({_arrays(columns, types)}) AS new"


_EVENT_TYPES: Final = {**_TYPES, "kind": "text"}
_APPEND: Final = f"""{_FENCE}, kept AS ({_insert("trial", f"task, {TRIAL_COLUMNS}", _TYPES)})
                     SELECT count(*) FROM fence"""
_EVENT: Final = f"""{_FENCE}, kept AS ({_insert("event", _EVENT_COLUMNS, _EVENT_TYPES)}),
    marked AS (UPDATE trial SET present_cost = new.cost, removed = new.removed, digest = new.digest FROM fence,
        unnest(%b::double precision[], %b::smallint[], %b::bytea[], %b::bigint[], %b::bytea[])
            AS new(cost, removed, digest, task, id) WHERE trial.task = new.task AND trial.id = new.id)
    , named AS (UPDATE task SET name = coalesce(%b::text, name) FROM fence WHERE id = %b::bigint)
    SELECT count(*) FROM fence"""
_CREATE: Final = f"""{_FENCE}, listed AS (INSERT INTO task (id, name) SELECT %b::bigint, %b::text FROM fence),
    kept AS ({_insert("event", _EVENT_COLUMNS, _EVENT_TYPES)}) SELECT count(*) FROM fence"""
_ADOPT_TRIALS: Final = f"INSERT INTO trial (task, {ROW_COLUMNS}) VALUES ({', '.join(['%b'] * 16)})"
_ADOPT_EVENTS: Final = f"INSERT INTO event ({_EVENT_COLUMNS}) VALUES ({', '.join(['%b'] * 6)})"
_HOLD: Final = "UPDATE log SET positions = positions + %s WHERE epoch = %s AND positions = %s RETURNING one"
_PURGE: Final = "UPDATE log SET purged = purged + %s WHERE epoch = %s RETURNING one"
_PATIENT: Final = "SET LOCAL statement_timeout = 0"  # a whole task's rows take long
_KNOWN: Final = "SELECT id, seq, digest FROM trial WHERE task = %b AND id = ANY(%b::bytea[])"
_ROWS: Final = f"SELECT {ROW_COLUMNS} FROM trial WHERE task = ? AND id = ?"
_CACHE: Final = """INSERT INTO cache (task, version, data, digest) VALUES (%b, %b, %b, %b) ON CONFLICT (task) DO UPDATE
                   SET version = excluded.version, data = excluded.data, digest = excluded.digest"""
_WORKER: Final = TRIAL_COLUMNS.split(", ").index("worker") + 1  # behind the task


@final
class PostgresLog:
    """A `TaskLog` by its URL, for the server that owns it.

    Args:
        url: The database.
        lease: Taken.

    Raises:
        StorageError: The tables hold less than was acknowledged, or are damaged.
        ShuttingDown: The database is away.
    """

    def __init__(self, url: str, lease: Lease, row: Ownership) -> None:
        self._url, self._lease, self._database = url, lease, PostgresDatabase(url)
        self.log_id: Final[UUID] = row.log_id
        self.reads: Final = LogReader(self._database)
        try:
            self._last = self.reads.positions()
            self._keys = {name: key for key, name in self._rows("SELECT id, name FROM task")}
            [(self._positions,)] = self._rows("SELECT positions FROM log")
            if lost := self.reads.lost_end():
                raise StorageError(f"{lost}; restore a backup")
        except BaseException:
            self.reads.close()
            raise
        self._writer: psycopg.Connection[Any] | None = None
        self._writing = threading.Lock()
        self._unknown = self._closing = self._closed = False
        self._lost: Callable[[str], None] = lambda _: None

    @property
    def where(self) -> str:
        """The URL, with its password if it has one: whoever reads the log by it needs that."""
        return self._url

    def keep(self, lost: Callable[[str], None]) -> None:
        """Keep the lease until `close`, and tell why the log is lost if it is."""
        self._lost = lost
        self._lease.keep(lost)

    def recover(self) -> list[tuple[str, list[LoggedTrial | Event]]]:
        """As `TaskLog.recover`."""
        if not self._unknown:
            return []
        with self._writing:
            [(epoch, positions)] = self._rows("SELECT epoch, positions FROM log")
            if epoch > self._lease.epoch:
                self._lost("another server owns the log now")
                raise ShuttingDown("another server owns the log now: ask that one", retry_ms=RETRY_MS)
            if epoch < self._lease.epoch or positions < self._positions:
                raise StorageError(
                    f"the database went back to an older state: it holds {positions} log positions, and "
                    f"{self._positions} were acknowledged; fail over to a copy that has them, or restart all servers "
                    "to go on with what is there"
                )
            names = {str(name): int(key) for key, name in self._rows("SELECT id, name FROM task")}
            found = []
            for name, last in self.reads.positions().items():
                if last > (known := self._last.get(name, 0)):
                    found.append((name, list(self.reads.read(name, known))))
                    self._last[name], self._keys[name] = last, names[name]
            if self._last.keys() != names.keys():  # what is served would have to change names in mid-flight
                self._lost("a task was renamed or deleted as the connection was lost: it is read anew")
                raise ShuttingDown("the log is read anew", retry_ms=RETRY_MS)
            self._positions, self._unknown = positions, False
        return found

    def create(self, spec: TaskSpec) -> Event:
        """As `TaskLog.create`."""
        key = max(self._keys.values(), default=0) + 1
        event, row = event_row(key, 1, "create", {"spec": spec.to_dict()})
        values = (key, spec.name, *([one] for one in row))
        self._write(f"create task {spec.name!r}", _CREATE, values, 1)
        self._keys[spec.name], self._last[spec.name] = key, 1
        return event

    def append_reports(self, reports: Sequence[PendingReport]) -> list[Stored | Conflict]:
        """As `TaskLog.append_reports`. Ids are looked up only if one turns out to be stored."""
        try:
            return self._append(reports, {})
        except errors.UniqueViolation:
            known: dict[tuple[int, bytes], tuple[int, bytes]] = {}
            with self._writing, database_errors("look up trials", self._writer):
                for report in reports:
                    key = self._keys[report.task]
                    rows = self._connected().execute(_KNOWN, (key, [one.id.bytes for one in report.trials]))
                    known |= {(key, one): (int(seq), digest) for one, seq, digest in rows}
            return self._append(reports, known)

    def _append(
        self, reports: Sequence[PendingReport], known: Mapping[tuple[int, bytes], tuple[int, bytes]]
    ) -> list[Stored | Conflict]:
        last = {report.task: self._last[report.task] for report in reports}
        new = NewRows(last)
        results = [
            new.add(self._keys[report.task], report, lambda key, one: known.get((key, one))) for report in reports
        ]
        if new.trials:
            columns = [list(column) for column in zip(*new.trials, strict=True)]
            columns[_WORKER] = [None if one is None else one.encode() for one in columns[_WORKER]]
            self._write("store trials", _APPEND, columns, len(new.trials))
        self._last.update(last)
        return results

    def append_event(self, task: str, kind: str, body: Mapping[str, Any]) -> Event:
        """As `TaskLog.append_event`."""
        key, seq = self._keys[task], self._last[task] + 1
        event, row = event_row(key, seq, kind, body)
        marks = list(changed_marks(event, lambda one: next(iter(self._rows(_ROWS, key, one)), None), key))
        columns = [list(column) for column in zip(*marks, strict=True)] or [[] for _ in range(5)]
        values = (*([one] for one in row), *columns, new_name(event), key)
        self._write(f"store {kind} of task {task!r}", _EVENT, values, 1)
        del self._keys[task], self._last[task]
        name = new_name(event) or task
        self._keys[name], self._last[name] = key, seq
        return event

    def purge(self) -> list[str]:
        """As `TaskLog.purge`. The count of positions stays, as servers that stand by compare it."""
        gone = [name for name in self._last if name.startswith(DELETED)]
        keys, positions = [self._keys[name] for name in gone], sum(self._last[name] for name in gone)
        with database_errors("purge the deleted tasks"), self._writing, self._connected().transaction() as block:
            cursor = block.connection.cursor().execute(_PATIENT)
            for table, column in (("trial", "task"), ("event", "task"), ("cache", "task"), ("task", "id")):
                statement = sql.SQL("DELETE FROM {} WHERE {} = ANY(%s)")
                cursor.execute(statement.format(sql.Identifier(table), sql.Identifier(column)), (keys,))
            if cursor.execute(_PURGE, (positions, self._lease.epoch)).fetchone() is None:
                raise StorageError("cannot purge the deleted tasks: another server owns the log now")
        for name in gone:
            del self._keys[name], self._last[name]
        return gone

    def adopt(self, task: str, events: Iterable[tuple[Any, ...]], trials: Iterable[tuple[Any, ...]]) -> int:
        """As `TaskLog.adopt`."""
        key = max(self._keys.values(), default=0) + 1
        at = _WORKER - 1
        added = 0
        with database_errors(f"copy task {task!r}"), self._writing, self._connected().transaction() as block:
            cursor = block.connection.cursor().execute(_PATIENT)
            cursor.execute("INSERT INTO task (id, name) VALUES (%s, %s)", (key, task))
            cursor.executemany(_ADOPT_EVENTS, [(key, *row) for row in events])
            added += cursor.rowcount
            cursor.executemany(
                _ADOPT_TRIALS,
                ((key, *row[:at], None if row[at] is None else row[at].encode(), *row[at + 1 :]) for row in trials),
            )
            added += cursor.rowcount
            if cursor.execute(_HOLD, (added, self._lease.epoch, self._positions)).fetchone() is None:
                raise StorageError(f"cannot copy task {task!r}: another server owns the log now")
        self._keys[task], self._last[task] = key, added
        self._positions += added
        return added

    def save_cache(self, task: str, version: int, data: bytes) -> None:
        """As `TaskLog.save_cache`."""
        doing = f"store the cache of task {task!r}"
        with self._writing, database_errors(doing, self._writer):
            digest = body_digest(f"cache {version}", data)
            self._connected().execute(_CACHE, (self._keys[task], version, data, digest))

    def sizes(self) -> tuple[int | None, None]:
        """Bytes of the tables; how much is free there is unknown here."""
        return self._database.size(), None

    def close(self) -> None:
        """As `TaskLog.close`; another server may take the log at once."""
        self._closing = True
        if not self._writing.acquire(timeout=_CLOSE_PATIENCE_S):
            raise StorageError("a commit to the database takes long; it ends by itself")
        try:
            if not self._closed:
                self._closed = True
                self._lease.give_up()
                self.reads.close()
                if self._writer is not None:
                    self._writer.close()
        finally:
            self._writing.release()

    def _write(self, doing: str, statement: str, values: Sequence[Any], added: int) -> None:
        """Run one statement that is fenced; raises `UniqueViolation` for an id that is stored."""
        with self._writing:
            if self._closing:
                raise ShuttingDown(f"cannot {doing}: the server is leaving the log", retry_ms=RETRY_MS)
            if self._unknown:
                raise ShuttingDown(f"cannot {doing}: the database is away", retry_ms=RETRY_MS)
            sent = False
            try:
                with database_errors(doing, self._writer):
                    connection = self._connected()
                    sent = True
                    fence = (added, self._lease.epoch, self._positions)
                    row = connection.execute(statement, (*fence, *values)).fetchone()
            except ShuttingDown:
                self._unknown = sent  # it may be stored, or not
                self._discard()
                raise
            if row is None or not row[0]:
                self._unknown = True  # taken by another server, or an earlier write came late
                raise ShuttingDown(f"cannot {doing}: the log has moved on; repeat it", retry_ms=RETRY_MS)
            self._positions += added

    def _rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        with database_errors("read the task log"):
            return self._database.rows(statement, *values)

    def _discard(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _connected(self) -> psycopg.Connection[Any]:
        if self._writer is None or self._writer.closed:
            self._writer = connect(self._url)
        return self._writer
