"""A standby server: it follows a shared log with its own models until it may serve.

It serves once no other server does, and takes all tasks; with peers, once it reaches all servers.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, final

from crkr.protocol import CrkrError, ShuttingDown
from crkr.server.learning.acceleration import Acceleration
from crkr.server.learning.restore import catch_up, restore_all
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import DELETED
from crkr.server.log.access import read_log
from crkr.server.log.postgres.lease import Lease
from crkr.server.log.postgres.log import PostgresLog
from crkr.server.log.postgres.url import printable_location
from crkr.server.log.reader import LogReader
from crkr.server.session import reachable_servers

__all__ = ["Follower"]

logger = logging.getLogger(__name__)

_LOOK_S: Final = 0.1  # between two looks at the log
_AWAY_S: Final = 0.5  # between attempts while the database is away
_KNOCK_S: Final = 1.0  # between attempts to reach the servers that serve
_PORT: Final = re.compile(r":(\d+)(?:[?#]|$)")  # of an endpoint


@final
class Follower:
    """Follows the log at a URL until this server may serve.

    Args:
        url: The database.
        endpoint: Where this server listens once it serves.
        say: Prints a line for people.
        peers: Endpoints of servers to share the tasks with; none: stand by while another server serves.
        zenoh_config: The server's Zenoh configuration file.
        known: Log positions that this process saw before.

    Raises:
        StorageError: The log is damaged or of another version, or the database refuses this server.
    """

    def __init__(
        self,
        url: str,
        endpoint: str,
        say: Callable[[str], None],
        peers: Sequence[str] = (),
        zenoh_config: Path | None = None,
        known: int = 0,
    ) -> None:
        self._url, self._say, self._peers, self._zenoh_config = url, say, peers, zenoh_config
        port = _PORT.search(endpoint)
        self._port = int(port[1]) if port else None
        self._tasks: dict[str, ServedTask] = {}
        self._lease: Lease | None = None
        self._reads: LogReader | None = None
        self._followed = -1  # positions of the log that the tasks include
        self._known = known
        self._acceleration = Acceleration()
        self._knock_at = 0.0  # [s, monotonic]
        self._told: str | None = None

    def take(self) -> tuple[PostgresLog, list[ServedTask]]:
        """Wait until this server may serve; returns the log, and the tasks that it owns, all or none.

        The process may end meanwhile without loss. Waits for a database that is away or went back to an older state,
        because no acknowledged entry may be missing.

        Raises:
            StorageError: As the class.
        """
        pause = 0.0
        while True:
            time.sleep(pause)
            try:
                log = self._step()
            except CrkrError as error:
                if not _passes(error):
                    self._end()
                    raise
                self._tell(f"waiting for the database: {error.message.partition('; repeat it')[0]}")
                pause = _AWAY_S
            else:
                if log is not None:
                    self._acceleration.stop()
                    if self._reads is not None:
                        self._reads.close()
                    return log, list(self._tasks.values())
                pause = _LOOK_S

    def _step(self) -> PostgresLog | None:
        if self._lease is None:
            self._lease = Lease(self._url, self._port)
        try:
            roster = self._lease.look()
        except ShuttingDown as error:
            if error.__cause__ is None:  # this process was held up, and others declared it dead
                self._lease.give_up()
                self._lease = None
            raise
        serving = [member for member in roster.serving if member.id != self._lease.me]
        if serving:
            if self._reaches({member.id.hex for member in serving}):
                self._tasks.clear()  # others own them, and added entries meanwhile
                return PostgresLog(self._url, self._lease)
            self._tell(f"standing by: the server at {serving[0].address} serves {printable_location(self._url)}")
        if self._reads is None:
            self._reads = read_log(self._url)
            with self._lease.beating():
                self._tasks = {task.name: task for task in restore_all(self._reads)}
        known = max(self._followed, self._known)
        if roster.positions < known:
            raise ShuttingDown(
                f"the database went back to an older state: it holds {roster.positions} log positions, and held "
                f"{known} before; fail over to a copy that has them, or restart all servers to go on with what is there"
            )
        if roster.positions != self._followed:
            with self._lease.beating():
                catch_up(self._reads, self._tasks)
            self._followed = roster.positions
            for task in self._tasks.values():
                self._acceleration.step(task)
        if serving or not (roster.serving or self._lease.join(roster)):  # it joined before the database went away
            return None
        began = time.monotonic()
        free = [row for row in self._lease.tasks() if not row.name.startswith(DELETED)]
        log = PostgresLog(self._url, self._lease, self._lease.take(free))
        with self._lease.beating():
            catch_up(log.reads, self._tasks)  # the last entries of the previous owner
        logger.info("took %d tasks in %.3f s", len(free), time.monotonic() - began)
        return log

    def _reaches(self, serving: set[str]) -> bool:
        """Whether the servers that serve can be reached through the peers; looked at once a second."""
        if not self._peers or time.monotonic() < self._knock_at:
            return False
        self._knock_at = time.monotonic() + _KNOCK_S
        return serving <= reachable_servers(self._peers, self._zenoh_config)

    def _end(self) -> None:
        self._acceleration.stop()
        if self._lease is not None:
            self._lease.give_up()
        if self._reads is not None:
            self._reads.close()

    def _tell(self, what: str) -> None:
        """Print once what it waits for."""
        if what != self._told:
            self._told = what
            self._say(what)


def _passes(error: BaseException | None) -> bool:
    """Whether an error means that the database is away for now."""
    while error is not None and not isinstance(error, ShuttingDown):
        error = error.__cause__
    return error is not None
