"""A server that stands by: it follows a shared log with models of its own, and takes the log when its owner is gone."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable
from typing import Final, final

from crkr.protocol import CrkrError, ShuttingDown, StorageError
from crkr.server.learning.restore import catch_up, restore_all
from crkr.server.learning.tasks import ServedTask
from crkr.server.log.access import read_log
from crkr.server.log.postgres.lease import Lease
from crkr.server.log.postgres.log import PostgresLog
from crkr.server.log.postgres.url import printable_location
from crkr.server.log.reader import LogReader

__all__ = ["Follower"]

logger = logging.getLogger(__name__)

_LOOK_S: Final = 0.1  # between two looks at the log
_AWAY_S: Final = 0.5  # between attempts while the database is away
_PORT: Final = re.compile(r":(\d+)(?:[?#]|$)")  # of an endpoint


@final
class Follower:
    """Follows the log at a URL until it can be taken.

    Args:
        url: The database.
        endpoint: Where this server listens once it owns the log.
        say: Prints a line for people.

    Raises:
        StorageError: The log is damaged or of another version, or the database refuses this server.
    """

    def __init__(self, url: str, endpoint: str, say: Callable[[str], None]) -> None:
        self._url, self._say = url, say
        port = _PORT.search(endpoint)
        self._port = int(port[1]) if port else None
        self._tasks: dict[str, ServedTask] = {}
        self._lease: Lease | None = None
        self._reads: LogReader | None = None
        self._followed = -1  # positions of the log that the tasks include
        self._told: str | None = None

    def take(self) -> tuple[PostgresLog, list[ServedTask]]:
        """Wait for the log; returns it, owned, and its tasks. Nothing is lost if the process ends meanwhile.

        Raises:
            StorageError: As the class. A database that is away is waited for.
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
                self._tell(f"waiting for the database: {error.message.partition(';')[0]}")
                pause = _AWAY_S
            else:
                if log is not None:
                    if self._reads is not None:
                        self._reads.close()
                    return log, list(self._tasks.values())
                pause = _LOOK_S

    def _step(self) -> PostgresLog | None:
        if self._lease is None or self._reads is None:
            self._lease = Lease(self._url, self._port)
            self._reads = read_log(self._url)
            self._tasks = {task.name: task for task in restore_all(self._reads)}
        row = self._lease.look()
        if row.positions < self._followed:
            raise StorageError(
                f"the database went back to an older state: it holds {row.positions} log positions, and held "
                f"{self._followed} before; fail over to a copy that has them, or restart all servers to go on with "
                "what is there"
            )
        if row.positions != self._followed:
            catch_up(self._reads, self._tasks)
            self._followed = row.positions
        if not self._lease.may_take(row):
            self._tell(f"standing by: the server at {row.address} owns the log in {printable_location(self._url)}")
            return None
        if not self._lease.take(row):
            return None
        began = time.monotonic()
        log = PostgresLog(self._url, self._lease, row)
        catch_up(log.reads, self._tasks)  # what the owner before stored last
        logger.info("took the log at epoch %d in %.3f s", self._lease.epoch, time.monotonic() - began)
        return log

    def _end(self) -> None:
        if self._lease is not None:
            self._lease.give_up()
        if self._reads is not None:
            self._reads.close()

    def _tell(self, what: str) -> None:
        """Print what it waits for, once."""
        if what != self._told:
            self._told = what
            self._say(what)


def _passes(error: BaseException | None) -> bool:
    """Whether an error comes of a database that is away for now."""
    while error is not None and not isinstance(error, ShuttingDown):
        error = error.__cause__
    return error is not None
