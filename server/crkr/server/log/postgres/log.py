"""The task log in PostgreSQL, written by the server that owns it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from psycopg import errors, sql

from crkr.protocol import Conflict, ShuttingDown, StorageError, TaskSpec
from crkr.server.log.entries import DELETED, Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.new_rows import NewRows, changed_marks, event_row, new_name
from crkr.server.log.postgres import statements
from crkr.server.log.postgres.connection import RETRY_MS, Connection, connect, database_errors
from crkr.server.log.postgres.database import PostgresDatabase
from crkr.server.log.postgres.lease import Lease, TaskRow
from crkr.server.log.reader import LogReader
from crkr.server.log.rows import TRIAL_COLUMNS, body_digest

__all__ = ["PostgresLog"]

logger = logging.getLogger(__name__)

_PATIENCE_S: Final = 6.0  # for a commit; a longer one is read back
_CLOSE_PATIENCE_S: Final = 0.5  # for a running commit
_WORKER: Final = TRIAL_COLUMNS.split(", ").index("worker") + 1  # behind the task


@final
@dataclass(slots=True)
class _Owned:
    """A task's key, the epoch at which this server took it, and its last known log position."""

    key: int
    epoch: int
    last: int


@final
class PostgresLog:
    """A `TaskLog` by its URL, for a server that owns some of its tasks.

    Raises:
        StorageError: The tables hold less than was acknowledged, or are damaged.
        ShuttingDown: The database is away.
    """

    def __init__(self, url: str, lease: Lease, rows: Iterable[TaskRow] = ()) -> None:
        self._url, self.lease, self._database = url, lease, PostgresDatabase(url)
        self.reads: Final = LogReader(self._database)
        self._owned: dict[str, _Owned] = {}
        for row in rows:
            self.own(row)
        try:
            [(self.log_id,)] = self._rows("SELECT id FROM log")
            if lost := self.reads.lost_end():
                raise StorageError(f"{lost}; restore a backup")
        except BaseException:
            self.reads.close()
            raise
        self._writer: Connection | None = None
        self._writing = threading.Lock()
        self._unknown = self._closing = self._closed = False
        self._naming = ""  # a task's name that is being stored
        self._lost: Callable[[str], None] = lambda _: None

    @property
    def where(self) -> str:
        """The URL, with its password if it has one, which readers of the log need."""
        return self._url

    def owns(self, task: str) -> bool:
        """Whether this server writes to a task, or is giving it that name."""
        return task == self._naming or task in self._owned

    def own(self, row: TaskRow) -> None:
        """Start to write to a task that the lease has taken."""
        self._owned[row.name] = _Owned(row.key, row.epoch, row.last)

    def hand_over(self, task: str) -> None:
        """Stop writing to a task and let another server take it; no write may be running."""
        own = self._owned.pop(task)
        self.lease.give(own.key, own.epoch)

    def keep(self, lost: Callable[[str], None], seen: Callable[[], None] = lambda: None) -> None:
        """Keep the lease until `close`; call `lost` with the reason if the tasks are lost."""
        self._lost = lost
        self.lease.keep(lost, seen)

    def recover(self) -> list[tuple[str, list[LoggedTrial | Event]]]:
        """As `TaskLog.recover`."""
        if not self._unknown:
            return []
        with self._writing:
            owned = dict(self._owned)
            rows = {row[0]: row[1:] for row in self._rows(statements.NOW, [own.key for own in owned.values()])}
            found = []
            for name, own in owned.items():
                now, last, epoch = rows.get(own.key, ("", own.last, own.epoch))
                if epoch > own.epoch:
                    self._lost("another server owns its tasks now")
                    raise moved(name)
                if epoch < own.epoch or last < own.last:
                    raise StorageError(
                        f"the database went back to an older state: it holds {last} log positions of task {name!r}, "
                        f"and {own.last} were acknowledged; fail over to a copy that has them, or restart all servers "
                        "to go on with what is there"
                    )
                if now != name:  # the served task would have to change its name during requests
                    self._lost("a task was renamed or deleted as the connection was lost: it is read again")
                    raise moved(name)
                if last > own.last:
                    found.append((name, list(self.reads.read(name, own.last))))
                    own.last = last
            self._unknown = False
        return found

    def create(self, spec: TaskSpec) -> Event:
        """As `TaskLog.create`."""
        event, (_, _, *row) = event_row(0, 1, "create", {"spec": spec.to_dict()})
        self._naming = spec.name
        try:
            [key] = self._write(
                f"create task {spec.name!r}", statements.CREATE, (spec.name, 1, self.lease.me, *row, True)
            )
            self._owned[spec.name] = _Owned(key, 1, 1)
        except errors.UniqueViolation:
            raise Conflict(f"there is a task {spec.name!r} already") from None
        finally:
            self._naming = ""
        return event

    def append_reports(self, reports: Sequence[PendingReport]) -> list[Stored | Conflict | ShuttingDown]:
        """As `TaskLog.append_reports`. Ids are looked up only after a conflict."""
        try:
            return self._append(reports, {})
        except errors.UniqueViolation:
            known: dict[tuple[int, bytes], tuple[int, bytes]] = {}
            with self._writing, database_errors("look up trials", self._writer):
                for report in reports:
                    if (own := self._owned.get(report.task)) is not None:
                        rows = self._connected().execute(
                            statements.KNOWN, (own.key, [one.id.bytes for one in report.trials])
                        )
                        known |= {(own.key, one): (int(seq), digest) for one, seq, digest in rows}
            return self._append(reports, known)

    def _append(
        self, reports: Sequence[PendingReport], known: Mapping[tuple[int, bytes], tuple[int, bytes]]
    ) -> list[Stored | Conflict | ShuttingDown]:
        owned = {report.task: own for report in reports if (own := self._owned.get(report.task)) is not None}
        last = {name: own.last for name, own in owned.items()}
        new = NewRows(last)
        results = [
            new.add(owned[report.task].key, report, lambda key, one: known.get((key, one)))
            if report.task in owned
            else moved(report.task)
            for report in reports
        ]
        changed = {own.key: name for name, own in owned.items() if last[name] != own.last}
        if not changed:
            return results
        columns = [list(column) for column in zip(*new.trials, strict=True)]
        columns[_WORKER] = [None if one is None else one.encode() for one in columns[_WORKER]]
        fence = [(key, owned[name].epoch, owned[name].last, last[name]) for key, name in changed.items()]
        kept = self._write(
            "store trials", statements.APPEND, [*map(list, zip(*fence, strict=True)), *columns], len(fence)
        )
        for key in kept:
            owned[changed[key]].last = last[changed[key]]
        fenced = {name for key, name in changed.items() if key not in kept}
        return [
            moved(report.task) if report.task in fenced and isinstance(result, Stored) else result
            for report, result in zip(reports, results, strict=True)
        ]

    def append_event(self, task: str, kind: str, body: Mapping[str, Any]) -> Event:
        """As `TaskLog.append_event`."""
        own = self._owned.get(task)
        if own is None:
            raise moved(task)
        event, row = event_row(own.key, own.last + 1, kind, body)
        marks = list(
            changed_marks(event, lambda one: next(iter(self._rows(statements.ROWS, own.key, one)), None), own.key)
        )
        columns = [list(column) for column in zip(*marks, strict=True)] or [[] for _ in range(5)]
        name = new_name(event)
        fence = (name, own.key, own.epoch, own.last)
        values = (*fence, *([one] for one in row), *columns, name is not None)
        self._naming = name or ""
        try:
            self._write(f"store {kind} of task {task!r}", statements.EVENT, values)
            own.last += 1
            if name is not None:
                self._owned[name] = self._owned.pop(task)
        except errors.UniqueViolation:
            raise Conflict(f"there is a task {name!r} already; choose another name") from None
        finally:
            self._naming = ""
        return event

    def purge(self) -> list[str]:
        """As `TaskLog.purge`. The count of positions stays, as standby servers compare it."""
        gone = [name for name in self._owned if name.startswith(DELETED)]
        keys, positions = [self._owned[name].key for name in gone], sum(self._owned[name].last for name in gone)
        with database_errors("purge the deleted tasks"), self._writing, self._connected().transaction() as block:
            self._connected().patience_s = None
            cursor = block.connection.cursor().execute(statements.PATIENT)
            if cursor.execute(statements.DISOWN, (keys, self.lease.me)).rowcount < len(keys):
                raise StorageError("cannot purge the deleted tasks: another server owns the log now")
            cursor.execute("UPDATE log SET purged = purged + %s", (positions,))
            for table in ("trial", "event", "cache", "summary"):
                cursor.execute(sql.SQL("DELETE FROM {} WHERE task = ANY(%s)").format(sql.Identifier(table)), (keys,))
        for name in gone:
            del self._owned[name]
        return gone

    def adopt(self, task: str, events: Iterable[tuple[Any, ...]], trials: Iterable[tuple[Any, ...]]) -> int:
        """As `TaskLog.adopt`."""
        at = _WORKER - 1
        with database_errors(f"copy task {task!r}"), self._writing, self._connected().transaction() as block:
            self._connected().patience_s = None
            cursor = block.connection.cursor().execute(statements.PATIENT)
            [(key,)] = cursor.execute(statements.NEW_TASK, (task, 0, self.lease.me)).fetchall()
            cursor.executemany(statements.ADOPT_EVENTS, [(key, *row) for row in events])
            added = cursor.rowcount
            cursor.executemany(
                statements.ADOPT_TRIALS,
                ((key, *row[:at], None if row[at] is None else row[at].encode(), *row[at + 1 :]) for row in trials),
            )
            added += cursor.rowcount
            cursor.execute("UPDATE task SET last = %s WHERE id = %s", (added, key))
        self._owned[task] = _Owned(key, 1, added)
        return added

    def describe(self, entries: Mapping[str, bytes]) -> None:
        """Store descriptions of tasks for other servers; a failure does no harm."""
        named = [(own.key, entry) for name, entry in entries.items() if (own := self._owned.get(name)) is not None]
        with self._writing, database_errors("describe the tasks", self._writer):
            self._connected().execute(statements.DESCRIBE, [list(column) for column in zip(*named, strict=True)])

    def described(self, tasks: Iterable[str]) -> dict[str, bytes]:
        """Descriptions of tasks by their servers."""
        return {str(name): bytes(entry) for name, entry in self._rows(statements.DESCRIBED, list(tasks))}

    def save_cache(self, task: str, version: int, data: bytes) -> None:
        """As `TaskLog.save_cache`."""
        own = self._owned.get(task)
        if own is None:
            return
        doing = f"store the cache of task {task!r}"
        with self._writing, database_errors(doing, self._writer):
            digest = body_digest(f"cache {version}", data)
            self._connected().execute(statements.CACHE, (own.key, version, data, digest))

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
                self.lease.give_up()
                self.reads.close()
                if self._writer is not None:
                    self._writer.close()
        finally:
            self._writing.release()

    def _write(self, doing: str, statement: str, values: Sequence[Any], tasks: int = 1) -> list[int]:
        """Run a fenced statement; returns the keys of its tasks, or of those still owned.

        Raises `UniqueViolation` for a stored id or name, and `ShuttingDown` if no task is owned any more.
        """
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
                    kept = [int(key) for (key,) in connection.execute(statement, values).fetchall()]
            except ShuttingDown:
                self._unknown = sent  # unknown whether it is stored
                self._discard()
                raise
            self._unknown = len(kept) < tasks  # taken by another server, or an earlier write came late
            if not kept:
                raise ShuttingDown(f"cannot {doing}: the log has moved on; repeat it", retry_ms=RETRY_MS)
            return kept

    def _rows(self, statement: str, *values: object) -> list[tuple[Any, ...]]:
        with database_errors("read the task log"):
            return self._database.rows(statement, *values)

    def _discard(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _connected(self) -> Connection:
        if self._writer is None or self._writer.closed:
            self._writer = connect(self._url, _PATIENCE_S)
        return self._writer


def moved(task: str) -> ShuttingDown:
    """The error for a task that another server owns now, or soon."""
    return ShuttingDown(f"another server owns task {task!r} now: ask again", retry_ms=RETRY_MS)
