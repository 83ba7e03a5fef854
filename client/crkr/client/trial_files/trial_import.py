"""Reports a file's trials to a task under their own ids, so that a second import changes nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, final
from uuid import UUID

import numpy as np

from crkr.client.task import Task
from crkr.client.trial_files.layout import FileRow
from crkr.protocol import MAX_TRIALS, Conflict, Invalid, Trial, pack

__all__ = ["Imported", "import_rows"]

_BATCH: Final = 256  # trials that are stored and learned from together
_BATCH_BYTES: Final = 2**20


@final
@dataclass(frozen=True, slots=True)
class Imported:
    """The result of an import.

    Attributes:
        accepted: Trials that were new to the task.
        duplicates: Trials that it had already.
        removed: Trials that were removed from the model because the file marks them as removed.
        packed: Trials whose `info` is valid only in an earlier version; it is kept as bytes.
    """

    accepted: int
    duplicates: int
    removed: int
    packed: int = 0


@final
class _Import:
    def __init__(self, task: Task, timeout_s: float) -> None:
        self._task, self._timeout_s = task, timeout_s
        self._known: dict[UUID, bytes] | None = None
        self.accepted = self.duplicates = 0

    def report(self, rows: Sequence[FileRow]) -> None:
        """Stores a batch and waits until the model includes it, so that other clients do not wait behind a backlog."""
        try:
            receipt = self._task.report_trials([row.trial for row in rows], wait=True, timeout_s=self._timeout_s)
        except Conflict as conflict:
            new = [row for row in rows if self._present().get(row.trial.id) != _content(row.trial)]
            if len(new) == len(rows):
                raise _in_row(conflict, rows) from conflict
            self.duplicates += len(rows) - len(new)
            if new:
                self.report(new)
            return
        self.accepted += receipt.accepted
        self.duplicates += receipt.duplicates

    def _present(self) -> dict[UUID, bytes]:
        """The present content of every trial; the server compares with the first report, before any new cost."""
        if self._known is None:
            self._known = {stored.trial.id: _content(stored.trial) for stored in self._task.iter_samples()}
        return self._known

    def remove(self, ids: Sequence[UUID]) -> int:
        """Removes trials that are still in the model; returns how many."""
        if not ids:
            return 0
        gone = {stored.trial.id for stored in self._task.iter_samples() if stored.removed}
        left = [one for one in ids if one not in gone]
        for first in range(0, len(left), MAX_TRIALS):
            chunk = left[first : first + MAX_TRIALS]
            self._task.remove(chunk, "removed where it was imported from", timeout_s=self._timeout_s)
        return len(left)


def import_rows(
    task: Task, rows: Iterable[FileRow], timeout_s: float, progress: Callable[[int], None] = lambda _: None
) -> Imported:
    """Reports rows in their order, in batches.

    Args:
        task: The task.
        rows: The trials.
        timeout_s: Deadline of each batch [s].
        progress: Called with the number of rows done.

    Raises:
        Conflict: The task has a trial of the same id with other content; the message names the row. The batches
            before are stored.
    """
    work = _Import(task, timeout_s)
    removed: list[UUID] = []
    done = packed = 0
    for batch in _batches(rows):
        work.report(batch)
        removed += [row.trial.id for row in batch if row.removed]
        packed += sum(row.packed for row in batch)
        done += len(batch)
        progress(done)
    return Imported(work.accepted, work.duplicates, work.remove(removed), packed)


def _batches(rows: Iterable[FileRow]) -> Iterator[list[FileRow]]:
    batch: list[FileRow] = []
    size = 0
    for row in rows:
        batch.append(row)
        size += _size(row.trial)
        if len(batch) >= _BATCH or size >= _BATCH_BYTES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def _content(trial: Trial) -> bytes:
    """A digest that treats an outcome of only NaN as absent: data frames write both as empty cells."""
    unseen = trial.outcome is not None and bool(np.isnan(trial.outcome).all())
    return (replace(trial, outcome=None) if unseen else trial).digest()


def _size(trial: Trial) -> int:
    """Approximate bytes in a message."""
    numbers = len(trial.state) + len(trial.goal) + (0 if trial.outcome is None else len(trial.outcome))
    return 8 * numbers + (len(pack(trial.info)) if trial.info else 0)


def _in_row(conflict: Conflict, rows: Sequence[FileRow]) -> Conflict | Invalid:
    """The conflict with the number of its row: the last row of that id is the one that differs."""
    numbers = {row.trial.id: row.number for row in rows}
    number = numbers.get(conflict.details.get("id", UUID(int=0)))
    if number is None:
        return conflict
    return Conflict(f"row {number}: {conflict.message}", details={**conflict.details, "row": number})
