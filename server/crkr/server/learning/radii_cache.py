"""Stores the selector's radii beside the log, for a quick restart. Nothing depends on them."""

from __future__ import annotations

import logging
import time
from typing import Final, final

import numpy as np

from crkr.learner import RadiiCache
from crkr.protocol import CrkrError
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import LogReader, TaskLog

__all__ = ["MANY", "RadiiKeeper", "load_radii", "save_radii"]

MANY: Final = 10_000  # entries from which on keeping the radii saves time
_EVERY: Final = 2000  # entries between two saves; a restart learns later ones one by one
_PAUSE_S: Final = 5.0  # least time between two saves of 24 bytes per sample

logger = logging.getLogger(__name__)


@final
class RadiiKeeper:
    """Stores the radii of long tasks from time to time, so that a restart after a crash is quick too."""

    def __init__(self, log: TaskLog) -> None:
        self._log = log
        self._kept: dict[str, tuple[int, float]] = {}

    def step(self, task: ServedTask) -> None:
        """Called on the learning thread whenever a task has a new model."""
        if task.deleted:
            return
        version, when = self._kept.get(task.name, (0, -np.inf))
        now = time.monotonic()
        if task.model.version > MANY and task.model.version - version >= _EVERY and now - when >= _PAUSE_S:
            self._kept[task.name] = (task.model.version, now)
            self._save(task)

    def finish(self, task: ServedTask) -> None:
        """Called when learning has ended."""
        kept = self._log.reads.load_cache(task.name)
        if task.model.version > MANY and not task.fault and (kept is None or kept[0] < task.model.version):
            self._save(task)

    def _save(self, task: ServedTask) -> None:
        radii = task.learner.radii()
        if radii is not None:
            save_radii(self._log, task.name, radii)


def save_radii(log: TaskLog, task: str, radii: RadiiCache) -> None:
    """Store the radii; a failure is only logged."""
    data = b"".join(
        np.ascontiguousarray(column, dtype=dtype).tobytes()
        for column, dtype in ((radii.seqs, "<i8"), (radii.squared, "<f8"), (radii.suppressors, "<i8"))
    )
    try:
        log.save_cache(task, radii.version, data)
    except CrkrError as error:
        logger.warning("%s", error.message)
    else:
        logger.debug("kept the radii of task %s at log position %d", task, radii.version)


def load_radii(log: LogReader, task: str) -> RadiiCache | None:
    """The last kept radii, or None."""
    kept = log.load_cache(task)
    if kept is None or len(kept[1]) % 24:
        return None
    version, data = kept
    n = len(data) // 24
    columns = [np.frombuffer(data, dtype, n, 8 * n * index) for index, dtype in enumerate(("<i8", "<f8", "<i8"))]
    return RadiiCache(version, columns[0], columns[1], columns[2])
