"""The selector's radii as bytes beside the log: they make a restart quick, and nothing depends on them."""

from __future__ import annotations

import logging

import numpy as np

from crkr.learner import RadiiCache
from crkr.protocol import CrkrError
from crkr.server.log import LogReader, TaskLog

__all__ = ["load_radii", "save_radii"]

logger = logging.getLogger(__name__)


def save_radii(log: TaskLog, task: str, radii: RadiiCache) -> None:
    """Keeps the radii; what goes wrong is only logged."""
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
    """The radii kept last, or None."""
    kept = log.load_cache(task)
    if kept is None or len(kept[1]) % 24:
        return None
    version, data = kept
    n = len(data) // 24
    columns = [np.frombuffer(data, dtype, n, 8 * n * index) for index, dtype in enumerate(("<i8", "<f8", "<i8"))]
    return RadiiCache(version, columns[0], columns[1], columns[2])
