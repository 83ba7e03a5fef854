"""Restore served tasks from the log."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import takewhile
from pathlib import Path
from typing import Final

import numpy as np

from crkr.learner import Learner, TrialColumns
from crkr.protocol import (
    KINDS,
    CrkrError,
    GoalDimension,
    ShuttingDown,
    StateDimension,
    StorageError,
    TaskSpec,
    UnknownTask,
)
from crkr.server.learning.acceleration import MUCH_TO_SEARCH, accelerate_search
from crkr.server.learning.radii_cache import load_radii
from crkr.server.learning.served_task import ServedTask, apply_entries
from crkr.server.log import DELETED, Event, LoggedTrial, LogReader, SqliteLog, Visible

__all__ = ["FEW", "batches", "begun", "catch_up", "open_directory", "relearned", "restore", "restore_all", "restored"]

logger = logging.getLogger(__name__)

_BATCH: Final = 4096
_LONGEST: Final = 1000  # characters of a task's fault
FEW: Final = 5000  # entries read as whole rows, each checked; longer logs are read by columns


def open_directory(directory: Path) -> tuple[SqliteLog, list[ServedTask]]:
    """Open the log in a data directory, which is created if missing, and restore its tasks.

    Raises:
        StorageError: In use, damaged, shorter than what was acknowledged, of a newer version, or not writable.
    """
    log = SqliteLog(directory)
    try:
        return log, restore_all(log.reads)
    except BaseException:
        log.close()
        raise


def restore_all(log: LogReader) -> list[ServedTask]:
    """Replay every task while the database is checked on another thread.

    A task that cannot be replayed is included, marked as faulty; the others are served.

    Raises:
        StorageError: The log is damaged.
    """
    try:
        with ThreadPoolExecutor(1) as beside:
            damage = beside.submit(log.integrity)
            tasks = [restored(log, name) for name in log.tasks() if not name.startswith(DELETED)]
        found = damage.result()
    except UnknownTask as error:
        raise StorageError(f"task log {log.where} lists a task that it does not find; restore a backup") from error
    except StorageError as error:
        raise StorageError(f"task log {log.where}: {error.message}") from error
    if found:
        raise StorageError(f"task log {log.where} is damaged: {'; '.join(found[:3])}; restore a backup")
    return tasks


def restored(log: LogReader, name: str) -> ServedTask:
    """The replayed task, or a faulty one that names the reason; raises `StorageError` as `restore`."""
    try:
        return restore(log, name)
    except (StorageError, UnknownTask):  # a fault of the store affects all tasks
        raise
    except Exception as error:
        fault = error.message if isinstance(error, CrkrError) else f"{type(error).__name__}: {error}"
        logger.exception("task %s is not served, as it cannot be restored; its log stays as it is", name)
        return _faulty(log, name, fault)


def _faulty(log: LogReader, name: str, fault: str) -> ServedTask:
    try:
        created = next(log.read(name))
        task = ServedTask(TaskSpec.from_dict(created.body["spec"]) if isinstance(created, Event) else _unknown(name))
        if isinstance(created, Event):
            task.begin(created)
    except StorageError:
        raise
    except Exception:
        task = ServedTask(_unknown(name))
    task.fault, task.restored, task.seq = fault[:_LONGEST], False, log.last(name)
    for event in log.events(name):  # its trials are still served with corrections
        task.corrections.note(event)
    return task


def _unknown(name: str) -> TaskSpec:
    """A stand-in for a specification that cannot be read, so that the task can be listed."""
    state, goal = StateDimension("unknown", "", 0.0, 1.0, 1.0), GoalDimension("unknown", "", 0.0, 1.0, 1.0)
    return TaskSpec(name, (state,), (goal,), "This task's specification cannot be read.")


def begun(creation: LoggedTrial | Event) -> ServedTask:
    """The task made by its first entry."""
    if not isinstance(creation, Event):
        raise StorageError(f"a log begins with a trial at position {creation.seq}; restore a backup")
    task = ServedTask(TaskSpec.from_dict(creation.body["spec"]))
    task.begin(creation)
    return task


def restore(log: LogReader, name: str) -> ServedTask:
    """Replay a task.

    Raises:
        StorageError: The log is damaged.
        Exception: The learner refuses an event, or numbers that an earlier version accepted.
    """
    started = time.monotonic()
    first = next(log.read(name), None)
    if not isinstance(first, Event) or first.kind != "create":
        raise StorageError(f"the log of task {name!r} does not begin with its creation; restore a backup")
    task = begun(first)
    last, radii = log.last(name), load_radii(log, name)
    visible = Visible.of(log.rollbacks(name), last)
    if last <= FEW:
        with task.learner.bulk():
            _replay_at_once(task, _upto(log.read(name, 1), last), visible)
    else:
        usable = radii is not None and last - FEW <= radii.version <= last and radii.version in visible
        upto = radii.version if radii is not None and usable else last
        if not usable and last > MUCH_TO_SEARCH and task.spec.selector == "anms":
            accelerate_search(name)
        with task.learner.bulk(radii if usable else None):
            _replay_blocks(task, log, name, upto, visible)
        _replay(task, _upto(log.read(name, upto), last), visible)
    task.publish()
    if task.name != name and not task.deleted:
        raise StorageError(f"the log of task {name!r} is that of {task.name!r}; restore a backup")
    logger.info("restored task %s at log position %d in %.2f s", name, task.seq, time.monotonic() - started)
    return task


def _upto(entries: Iterator[LoggedTrial | Event], last: int) -> Iterator[LoggedTrial | Event]:
    """The entries up to a log position; another server may be adding more."""
    return takewhile(lambda entry: entry.seq <= last, entries)


def relearned(log: LogReader, task: ServedTask, upto: int) -> Learner:
    """Relearns a task from its log up to a log position."""
    before = ServedTask(task.created)
    visible = Visible.of(log.rollbacks(task.name), upto)
    with before.learner.bulk():
        _replay_blocks(before, log, task.name, upto, visible)
    return before.learner


def _replay_blocks(task: ServedTask, log: LogReader, name: str, upto: int, visible: Visible) -> None:
    measured = len(task.created.outcome) if task.created.exploration.type == "outcome" else 0
    for entry in log.blocks(name, task.dimensions, len(task.created.goal), measured, upto):
        if isinstance(entry, Event):
            _replay_event(task, entry, visible)
        else:
            _replay_columns(task, entry, visible)


def _replay_at_once(task: ServedTask, entries: Iterator[LoggedTrial | Event], visible: Visible) -> None:
    for batch in batches(entries, _BATCH):
        if isinstance(batch, Event):
            _replay_event(task, batch, visible)
        else:
            _replay_columns(task, _columns(batch, len(task.created.outcome)), visible)


def _replay_event(task: ServedTask, event: Event, visible: Visible) -> None:
    task.note(event)
    if event.seq in visible:
        apply_entries(task.learner, event)


def _replay_columns(task: ServedTask, columns: TrialColumns, visible: Visible) -> None:
    task.note_columns(columns)
    task.learner.apply_columns(columns if visible.whole else columns.where(visible.mask(columns.seqs)))


def _columns(entries: list[LoggedTrial], measured: int) -> TrialColumns:
    """The trials as columns, which a store takes in a fraction of the time."""
    trials = [entry.trial for entry in entries]
    absent = np.full(measured, np.nan)
    return TrialColumns(
        seqs=np.array([entry.seq for entry in entries], dtype=np.int64),
        ids=b"".join([trial.id.bytes for trial in trials]),
        digests=b"".join([trial.digest() for trial in trials]),
        states=np.array([trial.state for trial in trials]),
        goals=np.array([trial.goal for trial in trials]),
        costs=np.array([trial.cost for trial in trials], dtype=np.float64),  # None becomes NaN
        kinds=np.array([KINDS.index(trial.kind) for trial in trials], dtype=np.uint8),
        flags=np.array([trial.flags for trial in trials], dtype=np.uint8),
        outcomes=np.array([absent if trial.outcome is None else trial.outcome for trial in trials]),
    )


def catch_up(log: LogReader, tasks: dict[str, ServedTask]) -> None:
    """Bring restored tasks to the end of a log that another server writes; adds new tasks.

    A task that cannot be brought there is marked as faulty, as by `restore_all`.

    Raises:
        StorageError: The log cannot be read, or is damaged.
        ShuttingDown: It is shorter than it was.
    """
    positions = {name: last for name, last in log.positions().items() if not name.startswith(DELETED)}
    for gone in tasks.keys() - positions.keys():  # renamed or deleted
        del tasks[gone]
    for name, last in positions.items():
        task = tasks.get(name)
        if task is None:
            tasks[name] = restored(log, name)
        elif last < task.seq:
            raise ShuttingDown(
                f"the log of task {name!r} ends at position {last} and ended at {task.seq} before: the database went "
                "back to an older state; fail over to a copy that has it all, or restart all servers to go on with "
                "what is there"
            )
        elif not task.restored:
            task.seq = last
        elif last > task.seq:
            try:
                _follow(log, name, tasks)
            except (StorageError, UnknownTask):
                raise
            except Exception as error:
                logger.exception("task %s is not followed any more", name)
                tasks[name] = _faulty(log, name, f"{type(error).__name__}: {error}")


def _follow(log: LogReader, name: str, tasks: dict[str, ServedTask]) -> None:
    task = tasks[name]
    entries = list(log.read(name, task.seq))
    if any(isinstance(entry, Event) and entry.kind == "rollback" for entry in entries):
        tasks[name] = restore(log, name)
        return
    _replay(task, iter(entries), Visible((), entries[-1].seq))
    task.publish()


def _replay(task: ServedTask, entries: Iterator[LoggedTrial | Event], visible: Visible) -> None:
    for batch in batches(entries, _BATCH):
        if isinstance(batch, Event):
            _replay_event(task, batch, visible)
            continue
        for entry in batch:
            task.note(entry)
        if counted := [entry for entry in batch if entry.seq in visible]:
            apply_entries(task.learner, counted)


def batches(entries: Iterable[LoggedTrial | Event], most: int) -> Iterable[list[LoggedTrial] | Event]:
    """The entries in order, with up to `most` successive trials in one batch."""
    trials: list[LoggedTrial] = []
    for entry in entries:
        if isinstance(entry, Event) or len(trials) == most:
            if trials:
                yield trials
            trials = []
        if isinstance(entry, Event):
            yield entry
        else:
            trials.append(entry)
    if trials:
        yield trials
