"""From the log back to a served task."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from crkr.protocol import StorageError, TaskSpec, UnknownTask
from crkr.server.applying import apply_entries, batches
from crkr.server.log import Event, LoggedTrial, LogReader
from crkr.server.radii_cache import load_radii
from crkr.server.tasks import ServedTask

__all__ = ["FEW", "restore", "restore_all"]

logger = logging.getLogger(__name__)

_BATCH: Final = 4096
FEW: Final = 5000  # entries that are cheaper to learn as they come, whole rows, than all radii are to find anew


def restore_all(log: LogReader, path: Path) -> list[ServedTask]:
    """Replays every task while the store looks itself over, on a thread that needs no interpreter for it.

    Raises:
        StorageError: The log, which is at `path`, is damaged.
    """
    try:
        with ThreadPoolExecutor(1) as beside:
            damage = beside.submit(log.integrity)
            tasks = [restore(log, name) for name in log.tasks()]
        found = damage.result()
    except UnknownTask as error:
        raise StorageError(f"task log {path} lists a task that it does not find; restore a backup") from error
    except StorageError as error:
        raise StorageError(f"task log {path}: {error.message}") from error
    if found:
        raise StorageError(f"task log {path} is damaged: {'; '.join(found[:3])}; restore a backup")
    return tasks


def restore(log: LogReader, name: str) -> ServedTask:
    """Replays a task.

    Raises:
        StorageError: The log is damaged.
    """
    started = time.monotonic()
    first = next(log.read(name), None)
    if not isinstance(first, Event) or first.kind != "create":
        raise StorageError(f"the log of task {name!r} does not begin with its creation; restore a backup")
    task = ServedTask(TaskSpec.from_dict(first.body["spec"]))
    if task.name != name:
        raise StorageError(f"the log of task {name!r} was begun as that of {task.name!r}; restore a backup")
    task.begin(first)
    last, radii = log.last(name), load_radii(log, name)
    if last <= FEW:
        _replay(task, log.read(name, 1))
    else:
        usable = radii is not None and last - FEW <= radii.version <= last
        upto = radii.version if radii is not None and usable else last
        with task.learner.bulk(radii if usable else None):
            _replay_blocks(task, log, upto)
        _replay(task, log.read(name, upto))
    task.publish()
    logger.info("restored task %s at log position %d in %.2f s", name, task.seq, time.monotonic() - started)
    return task


def _replay_blocks(task: ServedTask, log: LogReader, upto: int) -> None:
    measured = len(task.created.outcome) if task.created.exploration.type == "outcome" else 0
    for entry in log.blocks(task.name, task.dimensions, len(task.created.goal), measured, upto):
        if isinstance(entry, Event):
            task.note(entry)
            apply_entries(task.learner, entry)
        else:
            task.note_columns(entry)
            task.learner.apply_columns(entry)


def _replay(task: ServedTask, entries: Iterator[LoggedTrial | Event]) -> None:
    for batch in batches(entries, _BATCH):
        for entry in [batch] if isinstance(batch, Event) else batch:
            task.note(entry)
        apply_entries(task.learner, batch)
