"""Ownership of a log: the one row of the table `log` says which server may write to it.

Each take raises the epoch, and each write names the epoch of its server, so that a server that was replaced cannot
write any more. The lease only decides when another server may take: when the owner gave it up,
when its connection to the database is gone, as after a kill, or when it raised no `beat` for `LEASE_S` while the other
server watched. No clock is compared with another one's.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, final
from uuid import UUID, uuid4

import psycopg

from crkr.server.log.postgres.connection import connect, database_errors, prepare
from crkr.server.thread_faults import keep_running

__all__ = ["LEASE_S", "Lease", "Ownership"]

logger = logging.getLogger(__name__)

LEASE_S: Final = 3.0
_BEAT_S: Final = LEASE_S / 6
_KNOCK_S: Final = 0.3  # for the connection to another server
_LOOK: Final = """SELECT id, epoch, positions, beat, owner, address, EXISTS (SELECT FROM pg_stat_activity AS session
                    WHERE session.pid = backend AND coalesce(session.backend_start, log.backend_start)
                          = log.backend_start) FROM log"""
_SESSION: Final = """backend = pg_backend_pid(), backend_start =
                     (SELECT backend_start FROM pg_stat_activity WHERE pid = pg_backend_pid())"""
_TAKE: Final = f"""UPDATE log SET epoch = epoch + 1, beat = beat + 1, owner = %s, address = %s, {_SESSION}
                   WHERE epoch = %s AND beat = %s AND positions >= %s RETURNING epoch"""
_BEAT: Final = "UPDATE log SET beat = beat + 1 WHERE epoch = %s RETURNING standbys"
_RETURN: Final = f"UPDATE log SET beat = beat + 1, {_SESSION} WHERE epoch = %s RETURNING standbys"
_GIVE_UP: Final = "UPDATE log SET beat = beat + 1, owner = NULL, backend = NULL WHERE epoch = %s"
_STAND_BY: Final = """UPDATE log SET standbys = (array_append(array_remove(standbys, %(me)s), %(me)s))
                      [greatest(1, cardinality(array_remove(standbys, %(me)s)) - 6):]"""
_ADDRESS: Final = "SELECT coalesce(host(inet_client_addr()), '127.0.0.1')"


@final
@dataclass(frozen=True, slots=True)
class Ownership:
    """The row as it was read.

    Attributes:
        log_id: Identifies the log.
        epoch: How often it was taken.
        positions: Log positions of all tasks together.
        beat: Changes as long as the owner lives.
        owner: The server that owns it; None: it was given up.
        address: Where that server listens.
        connected: The owner's connection to the database stands.
    """

    log_id: UUID
    epoch: int
    positions: int
    beat: int
    owner: UUID | None
    address: str | None
    connected: bool


@final
class Lease:
    """One server's claim to a log: first it watches, then it takes, then it keeps what it took.

    Args:
        url: The database.
        port: Where this server listens once it owns the log; None if unknown.

    Attributes:
        epoch: The one taken; 0 before.

    Raises:
        StorageError: The tables are of another version, or the database refuses.
        ShuttingDown: The database is away.
    """

    def __init__(self, url: str, port: int | None = None) -> None:
        self.epoch = 0
        self._url, self._port, self._me = url, port, uuid4()
        self._connection: psycopg.Connection[Any] | None = None
        self._address = ""
        self._reconnected: float | None = None  # [s, monotonic]
        self._seen: tuple[int, int] | None = None  # epoch and beat
        self._unchanged_since = 0.0
        self._stopped = threading.Event()
        self._standbys: Sequence[str] = ()
        self._away = False
        self._thread: threading.Thread | None = None
        try:
            with database_errors("open the task log"):
                prepare(self._connected(), url, create=True)
                if self._port is not None:
                    self._connected().execute(_STAND_BY, {"me": self._address})
        except BaseException:
            self.give_up()
            raise

    def look(self) -> Ownership:
        """Read the row; raises as `Lease` does."""
        connection = self._connection
        with database_errors("read who owns the task log", connection):
            row = self._connected().execute(_LOOK).fetchone()
        if row is None:
            raise RuntimeError("the table log has no row")
        return Ownership(*row)

    def may_take(self, row: Ownership) -> bool:
        """Whether the owner is gone; call it again and again with the latest row."""
        now = time.monotonic()
        if self._seen != (row.epoch, row.beat):
            self._seen, self._unchanged_since = (row.epoch, row.beat), now
        if row.owner is None:
            return True
        # Behind a restart of the database nobody is connected yet: an owner that lives comes back within its lease.
        if not row.connected and (self._reconnected is None or now - self._reconnected > LEASE_S):
            return True
        return now - self._unchanged_since > LEASE_S

    def take(self, row: Ownership) -> bool:
        """Own the log from now on, unless it changed hands, or its owner gave a sign of life, since `row` was read."""
        connection = self._connection
        with database_errors("take the task log", connection):
            values = (self._me, self._address, row.epoch, row.beat, row.positions)
            taken = self._connected().execute(_TAKE, values).fetchone()
        if taken is None:
            return False
        self.epoch = int(taken[0])
        return True

    def keep(self, lost: Callable[[str], None]) -> None:
        """Give signs of life on a thread of its own, and tell once why the log is lost."""
        step = partial(self._beat, lost)
        self._thread = threading.Thread(target=keep_running, args=(step,), name="lease", daemon=True)
        self._thread.start()

    def give_up(self) -> None:
        """Let another server take the log at once; idempotent."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join(_BEAT_S)
        if self._connection is not None and (self._thread is None or not self._thread.is_alive()):
            with self._connection, suppress(psycopg.Error):
                if self.epoch and not self._connection.closed:
                    self._connection.execute(_GIVE_UP, (self.epoch,))

    def _beat(self, lost: Callable[[str], None]) -> bool:
        if self._stopped.wait(_BEAT_S):
            return False
        try:
            back = self._connection is None or self._connection.closed
            found = self._connected().execute(_RETURN if back else _BEAT, (self.epoch,)).fetchone()
        except psycopg.Error as error:
            if not self._away:
                logger.warning("the database is away, reports wait: %s", " ".join(str(error).split()))
            self._away = True
            if self._connection is not None:
                self._connection.close()
            if (other := self._successor()) is not None:
                lost(f"another server answers at {other}, and the database is away from here")
                return False
            return True
        if found is None:
            lost("another server owns the log now")
            return False
        if self._away:
            logger.info("the database is back")
        self._away = False
        self._standbys = [one for one in found[0] if one != self._address]
        return True

    def _successor(self) -> str | None:
        """The address of a server that stood by and listens now, which it does only once it owns the log."""
        for address in self._standbys:
            host, _, port = address.rpartition(":")
            with suppress(OSError), socket.create_connection((host, int(port)), _KNOCK_S):
                return address
        return None

    def _connected(self) -> psycopg.Connection[Any]:
        if self._connection is None or self._connection.closed:
            before, self._connection = self._connection, connect(self._url)
            if before is not None:
                self._reconnected = time.monotonic()
            row = self._connection.execute(_ADDRESS).fetchone()
            self._address = f"{row[0] if row else ''}:{self._port or 0}"
        return self._connection
