"""A task's stored trials, read without its server or beside it; `crkr watch --replay` finds this by entry point.

The log is read page by page. Nothing is locked or written, so a running server is not affected.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, final

from crkr.protocol import CrkrError, StorageError, StoredTrial, TaskSpec, UnknownTask
from crkr.server.log import Corrections, Event, read_log
from crkr.server.log.postgres.url import is_url, printable_location

__all__ = ["StoredRun"]

_MOST_BYTES: Final = 2**24


@final
class StoredRun:
    """One task of a log at this moment; not thread-safe.

    Attributes:
        spec: The specification in force.
        last: Log position of the last entry; later entries are ignored.

    Raises:
        StorageError: There is no log, or it is damaged.
        UnknownTask: No such task; the message names the existing ones.
    """

    def __init__(self, data: str | Path, task: str) -> None:
        if not is_url(data) and not Path(data).is_dir():
            raise StorageError(f"there is no data directory {data}")
        self._reader = read_log(data)
        self._task = task
        self._corrections = Corrections()
        try:
            positions = self._reader.positions()
            if lost := self._reader.lost_end():
                raise StorageError(f"{lost}; restore a backup")
            if task not in positions:
                there = f"it has {', '.join(positions)}" if positions else "it has none yet"
                raise UnknownTask(f"{printable_location(data)} holds no task {task!r}; {there}", details={"task": task})
            self.last: Final = positions[task]
            self.spec: Final = self._in_force()
        except BaseException:
            self._reader.close()
            raise

    def pages(self, size: int) -> Iterator[tuple[list[StoredTrial], dict[str, Any]]]:
        """All trials in the order of seq, in pages of at most `size`, each with the learner's counts.

        The counts are `seq`, `eligible` and `active`, as in a server's status, with today's costs, removals and
        settings.

        Raises:
            StorageError: A trial is damaged.
        """
        eligible, after = 0, 0
        following: int | None = 0
        while following is not None:
            entries, following = self._reader.page(self._task, after, size, _MOST_BYTES)
            present = map(self._corrections.present, entries)
            trials = [self._trial(entry) for entry in present if entry["seq"] <= self.last]
            if not trials:
                return
            after = trials[-1].seq
            eligible += sum(map(self._is_eligible, trials))
            active = eligible if self.spec.selector == "full" else min(eligible, self.spec.budget)
            yield trials, {"seq": after, "eligible": eligible, "active": active}

    def close(self) -> None:
        """Close the log; idempotent."""
        self._reader.close()

    def _in_force(self) -> TaskSpec:
        """Read the whole log once for changed settings, which also finds missing entries."""
        first = next(self._reader.read(self._task), None)
        if not isinstance(first, Event) or first.kind != "create":
            raise StorageError(f"the log of task {self._task!r} does not begin with its creation; restore a backup")
        try:
            spec = TaskSpec.from_dict(first.body["spec"])
            for entry in self._reader.blocks(self._task, len(spec.state), len(spec.goal), 0, self.last):
                if not isinstance(entry, Event):
                    continue
                self._corrections.note(entry)
                if entry.kind == "rollback":
                    spec = TaskSpec.from_dict(entry.body["spec"])
                elif entry.kind == "configure":
                    spec = spec.with_changes(entry.body["changes"])
        except StorageError:
            raise
        except (CrkrError, LookupError) as error:
            raise StorageError(
                f"the log of task {self._task!r} holds settings that cannot be: {error}; restore a backup"
            ) from error
        return spec

    def _trial(self, entry: dict[str, Any]) -> StoredTrial:
        try:
            return StoredTrial.from_wire(entry, self.spec)
        except CrkrError as error:
            raise StorageError(
                f"the trial at log position {entry['seq']} is damaged: {error.message}; restore a backup"
            ) from error

    def _is_eligible(self, stored: StoredTrial) -> bool:
        return not stored.removed and stored.trial.eligible(self.spec.learn_from)
