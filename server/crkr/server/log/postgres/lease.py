"""Which servers share a log, and which of them owns each task.

Each server has a row and raises its `beat`. When a server leaves, or another finds it dead, the row is deleted and its
tasks are free. A server is dead when its connection to the database is gone, as after a kill, or when its beat did not
change for `LEASE_S` while the other watched. Clocks are never compared.

Each take of a task raises the epoch in the task's row, and each write names the epoch that its server took, so a
replaced server cannot write.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, final
from uuid import UUID, uuid4

import psycopg

from crkr.protocol import CrkrError, ShuttingDown
from crkr.server.log.postgres.connection import RETRY_MS, Connection, connect, database_errors
from crkr.server.log.postgres.schema import prepare
from crkr.server.thread_faults import keep_running

__all__ = ["LEASE_S", "Lease", "Member", "Roster", "TaskRow"]

logger = logging.getLogger(__name__)

LEASE_S: Final = 3.0
_BEAT_S: Final = LEASE_S / 6
_LOOK_S: Final = 0.1  # between looks at the other servers
_PATIENCE_S: Final = 2.0  # for an answer of the database; an owner must notice its absence before its lease ends
_KNOCK_S: Final = 0.3  # for the connection to another server
_STARTED: Final = "(SELECT backend_start FROM pg_stat_activity WHERE pid = pg_backend_pid())"
_ENTER: Final = f"""INSERT INTO server (id, address, backend, backend_start)
                    VALUES (%s, %s, pg_backend_pid(), {_STARTED})"""
_POSITIONS: Final = "(SELECT coalesce(sum(last), 0)::bigint + purged FROM task)"
_LOOK: Final = f"""SELECT log.id, epoch, {_POSITIONS}, server.id, number, address,
                    serves, beat, EXISTS (SELECT FROM pg_stat_activity AS session
                    WHERE session.pid = backend AND coalesce(session.backend_start, server.backend_start)
                          = server.backend_start) FROM log LEFT JOIN server ON true ORDER BY number"""
_BEAT: Final = "UPDATE server SET beat = beat + 1 WHERE id = %s RETURNING true"
_RETURN: Final = f"""UPDATE server SET beat = beat + 1, backend = pg_backend_pid(), backend_start = {_STARTED}
                     WHERE id = %s RETURNING true"""
_JOIN: Final = f"""WITH told AS (UPDATE log SET epoch = epoch + 1 WHERE epoch = %s
                                AND {_POSITIONS} >= %s RETURNING one)
                  UPDATE server SET serves = true FROM told WHERE id = %s RETURNING true"""
_REMOVE: Final = """WITH gone AS (DELETE FROM server WHERE id = %s AND beat = coalesce(%s, beat) RETURNING id)
                    UPDATE log SET epoch = epoch + 1 FROM gone RETURNING epoch"""
_TASKS: Final = "SELECT id, name, last, epoch, owner FROM task ORDER BY id"
_TAKE: Final = """WITH taken AS (UPDATE task SET owner = server.id, epoch = task.epoch + 1
                    FROM unnest(%s::bigint[], %s::bigint[]) AS seen(id, epoch), server
                    WHERE task.id = seen.id AND task.epoch = seen.epoch AND server.id = %s
                    RETURNING task.id, name, last, task.epoch, owner),
                  told AS (UPDATE log SET epoch = epoch + 1 WHERE EXISTS (SELECT FROM taken))
                  SELECT * FROM taken ORDER BY id"""
_GIVE: Final = """WITH given AS (UPDATE task SET owner = NULL WHERE id = %s AND epoch = %s RETURNING id)
                  UPDATE log SET epoch = epoch + 1 FROM given"""
_ADDRESS: Final = "SELECT coalesce(host(inet_client_addr()), '127.0.0.1')"


@final
@dataclass(frozen=True, slots=True)
class Member:
    """A server's row.

    Attributes:
        id: Of the server and of its Zenoh session.
        number: Order of arrival.
        address: Its address, once it serves.
        serves: Whether it may own tasks; otherwise it stands by.
        beat: Changes while it lives.
        connected: Whether it is connected to the database.
    """

    id: UUID
    number: int
    address: str
    serves: bool
    beat: int
    connected: bool


@final
@dataclass(frozen=True, slots=True)
class TaskRow:
    """A task's row: its key, name, last log position, how often it was taken, and who took it last."""

    key: int
    name: str
    last: int
    epoch: int
    owner: UUID | None


@final
@dataclass(frozen=True, slots=True)
class Roster:
    """The servers of a log at a moment.

    Attributes:
        log_id: Identifies the log.
        epoch: Changes with the servers, the tasks' owners and the tasks' names.
        positions: Sum of the log positions of all tasks, purged ones included.
        members: The living servers in order of arrival.
    """

    log_id: UUID
    epoch: int
    positions: int
    members: tuple[Member, ...]

    @property
    def serving(self) -> list[Member]:
        """The servers that may own tasks."""
        return [member for member in self.members if member.serves]


@final
class Lease:
    """One server's part in a log: it watches the others, serves with them, and takes tasks; any thread may call it.

    Args:
        url: The database.
        port: Where this server listens once it serves; None if unknown.

    Attributes:
        me: The server's id.
        roster: The last one seen on the thread of `keep`; None before, and while the database is away.
        positions: The largest number of log positions seen.

    Raises:
        StorageError: The tables are of another version, or the database refuses.
        ShuttingDown: The database is away, or other servers declared this one dead.
    """

    def __init__(self, url: str, port: int | None = None) -> None:
        self.me: Final = _zenoh_id()
        self.roster: Roster | None = None
        self.positions = 0
        self._url, self._port = url, port
        self._connection: Connection | None = None
        self._using = threading.RLock()
        self._reconnected: float | None = None  # [s, monotonic]
        self._beaten = 0.0
        self._watched: dict[UUID, tuple[int, float]] = {}  # each server's beat, and the time of its last change
        self._away, self._standing_by = False, list[str]()
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        try:
            with database_errors("open the task log"):
                connection = self._connected()
                connection.patience_s = None
                prepare(connection, url, create=True)
                connection.patience_s = _PATIENCE_S
                [host] = connection.execute(_ADDRESS).fetchone() or ("",)
                connection.execute(_ENTER, (self.me, f"{host}:{port or 0}"))
                self._beaten = time.monotonic()
        except BaseException:
            self.give_up()
            raise

    def look(self) -> Roster:
        """Read the roster, beat if it is due, and remove dead servers; raises as the class does."""
        with self._using, database_errors("read who owns the task log", self._connection):
            back = self._connection is None or self._connection.closed
            connection = self._connected()
            if back or time.monotonic() - self._beaten >= _BEAT_S:
                if connection.execute(_RETURN if back else _BEAT, (self.me,)).fetchone() is None:
                    raise ShuttingDown("another server took this one for dead, and its tasks", retry_ms=RETRY_MS)
                self._beaten = time.monotonic()
            rows = connection.execute(_LOOK).fetchall()
            if not rows:
                raise RuntimeError("the table log has no row")
            members = tuple(Member(*row[3:]) for row in rows if row[3] is not None)
            log_id, epoch, positions = rows[0][:3]
            roster = Roster(log_id, epoch, positions, members)
            self.positions = max(self.positions, roster.positions)
            for member in members:
                if member.id != self.me and self._is_dead(member):
                    gone = connection.execute(_REMOVE, (member.id, member.beat)).fetchone()
                    if gone is not None:  # it gave no sign of life since
                        left = tuple(one for one in roster.members if one.id != member.id)
                        roster = replace(roster, epoch=gone[0], members=left)
                        logger.warning("the server at %s is gone", member.address)
            return roster

    def _is_dead(self, member: Member) -> bool:
        now = time.monotonic()
        beat, since = self._watched.get(member.id, (None, now))
        if beat != member.beat:
            since = now
            self._watched[member.id] = member.beat, since
        # After a restart of the database nobody is connected yet; a living server reconnects within its lease.
        if not member.connected and (self._reconnected is None or now - self._reconnected > LEASE_S):
            return True
        return now - since > LEASE_S

    def join(self, roster: Roster) -> bool:
        """Serve from now on, unless the servers or owners changed since the roster was read."""
        return self._run("join the servers", _JOIN, roster.epoch, roster.positions, self.me) != []

    def tasks(self) -> list[TaskRow]:
        """All tasks, the oldest first."""
        return [TaskRow(*row) for row in self._run("read who owns the tasks", _TASKS)]

    def take(self, rows: Iterable[TaskRow]) -> list[TaskRow]:
        """Take these tasks, except those that changed hands since they were read; returns the rows taken."""
        seen = [(row.key, row.epoch) for row in rows]
        keys, epochs = [key for key, _ in seen], [epoch for _, epoch in seen]
        return [TaskRow(*row) for row in self._run("take tasks", _TAKE, keys, epochs, self.me)]

    def give(self, key: int, epoch: int) -> None:
        """Hand a task over."""
        self._run("hand a task over", _GIVE, key, epoch)

    @contextmanager
    def beating(self) -> Iterator[None]:
        """Beat on a separate thread until the end of the block, which may take long."""
        done = threading.Event()

        def beat() -> None:
            while not done.wait(_BEAT_S):
                with suppress(CrkrError):  # the next look reports it
                    self.look()

        thread = threading.Thread(target=beat, name="lease", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def keep(self, lost: Callable[[str], None], seen: Callable[[], None] = lambda: None) -> None:
        """Look from a separate thread; call `seen` after each look, and `lost` once with the reason to stop serving."""
        step = partial(self._step, lost, seen)
        self._thread = threading.Thread(target=keep_running, args=(step,), name="lease", daemon=True)
        self._thread.start()

    def give_up(self) -> None:
        """Release the tasks at once; idempotent."""
        self._stopped.set()
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(_BEAT_S)
        if self._connection is not None and (self._thread is None or not self._thread.is_alive()):
            with self._connection, suppress(psycopg.Error):
                if not self._connection.closed:
                    self._connection.execute(_REMOVE, (self.me, None))

    def _step(self, lost: Callable[[str], None], seen: Callable[[], None]) -> bool:
        known = self.roster
        alone = known is not None and len(known.members) == 1
        if self._stopped.wait(_BEAT_S if alone or self._away else _LOOK_S):
            return False
        try:
            self.roster = self.look()
        except CrkrError as error:
            if isinstance(error, ShuttingDown) and error.__cause__ is None:
                lost(error.message)
                return False
            if not self._away:
                logger.warning("reports wait: %s", error.message.partition(";")[0])
                self._standing_by = [one.address for one in known.members if not one.serves] if known else []
            self._away, self.roster = True, None
            self._discard()
            if (other := self._successor()) is not None:
                lost(f"another server answers at {other}, and the database is away from here")
                return False
        else:
            if self._away:
                logger.info("the database is back")
            self._away = False
        seen()
        return True

    def _successor(self) -> str | None:
        """The address of a former standby server that listens now, and so owns tasks."""
        for address in self._standing_by:
            host, _, port = address.rpartition(":")
            with suppress(OSError), socket.create_connection((host, int(port)), _KNOCK_S):
                return address
        return None

    def _run(self, doing: str, statement: Any, *values: object) -> list[tuple[Any, ...]]:
        with self._using, database_errors(doing, self._connection):
            cursor = self._connected().execute(statement, values)
            return cursor.fetchall() if cursor.description else []

    def _discard(self) -> None:
        with self._using:
            if self._connection is not None:
                self._connection.close()

    def _connected(self) -> Connection:
        if self._connection is None or self._connection.closed:
            before, self._connection = self._connection, connect(self._url, _PATIENCE_S)
            if before is not None:
                self._reconnected = time.monotonic()
        return self._connection


def _zenoh_id() -> UUID:
    """A random id whose first digit is not 0, as Zenoh asks for."""
    while (made := uuid4()).hex.startswith("0"):
        pass
    return made
