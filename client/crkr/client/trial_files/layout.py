"""Trials as rows of named columns, the same in every kind of file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, final
from uuid import UUID

from crkr.client.trial_files.info_json import info_from_json, info_to_json
from crkr.protocol import Invalid, StoredTrial, TaskSpec, Trial
from crkr.protocol.checks import flag

__all__ = ["ColumnType", "FileRow", "Layout"]

ColumnType = Literal["int", "float", "text", "flag"]

_REQUIRED: Final[Mapping[str, ColumnType]] = {"id": "text", "kind": "text", "success": "flag", "cost": "float"}
# What may be left out. The first two are the server's own: an import gets new ones.
_OPTIONAL: Final[Mapping[str, ColumnType]] = {
    "seq": "int",
    "time": "float",
    "worker": "text",
    "model_version": "int",
    "removed": "flag",
    "info": "text",
}


@final
@dataclass(frozen=True, slots=True)
class FileRow:
    """One trial of a file.

    Attributes:
        number: Its row, from 1.
        trial: What was reported, with the cost that held when it was written.
        removed: It had been taken out of learning.
    """

    number: int
    trial: Trial
    removed: bool


@final
class Layout:
    """The columns of one task's files: a trial's fields, and `state.<name>`, `goal.<name>`, `outcome.<name>`.

    Attributes:
        spec: The task.
        state: Names of its d columns.
        goal: Names of its p columns.
        outcome: Names of its q columns.
        types: Every column with the type of its values; any may be empty.
    """

    def __init__(self, spec: TaskSpec) -> None:
        self.spec: Final = spec
        self.state: Final = tuple(f"state.{axis.name}" for axis in spec.state)
        self.goal: Final = tuple(f"goal.{axis.name}" for axis in spec.goal)
        self.outcome: Final = tuple(f"outcome.{entry.name}" for entry in spec.outcome)
        numbers: dict[str, ColumnType] = dict.fromkeys((*self.state, *self.goal, *self.outcome), "float")
        self.types: Final[Mapping[str, ColumnType]] = {**_REQUIRED, **numbers, **_OPTIONAL}

    def check(self, found: Collection[str]) -> None:
        """Looks at a file's columns; those that mean nothing here are ignored.

        Raises:
            Invalid: One is missing or comes twice, or there are coordinates that the task has not.
        """
        missing = [name for name in (*_REQUIRED, *self.state, *self.goal) if name not in found]
        if missing:
            raise Invalid(f"column {missing[0]!r} is missing; there are: {', '.join(found) or 'none'}")
        twice = [name for name, times in Counter(list(found)).items() if times > 1 and name in self.types]
        if twice:
            raise Invalid(f"column {twice[0]!r} comes twice; leave one out")
        for name in found:
            if name.startswith(("state.", "goal.", "outcome.")) and name not in self.types:
                raise Invalid(f"column {name!r} is no coordinate of task {self.spec.name!r}")

    def columns(self, stored: Sequence[StoredTrial]) -> dict[str, list[Any]]:
        """Values by column, None where there is none."""
        trials = [one.trial for one in stored]
        return {
            "id": [str(trial.id) for trial in trials],
            "kind": [trial.kind for trial in trials],
            "success": [trial.success for trial in trials],
            "cost": [trial.cost for trial in trials],
            **_by_coordinate(self.state, [trial.state.tolist() for trial in trials]),
            **_by_coordinate(self.goal, [trial.goal.tolist() for trial in trials]),
            **_by_coordinate(self.outcome, [_numbers(trial, len(self.outcome)) for trial in trials]),
            "seq": [one.seq for one in stored],
            "time": [one.time for one in stored],
            "worker": [trial.worker for trial in trials],
            "model_version": [trial.model_version for trial in trials],
            "removed": [one.removed for one in stored],
            "info": [info_to_json(trial.info) if trial.info else None for trial in trials],
        }

    def row(self, number: int, values: Mapping[str, Any]) -> FileRow:
        """Checks one row's values by column.

        Raises:
            Invalid: A value that no trial of the task can have; the message names the row.
        """
        try:
            removed = values.get("removed")
            return FileRow(number, self._trial(values), removed is not None and flag(removed, "removed"))
        except Invalid as error:
            raise Invalid(f"row {number}: {error.message}", details={**error.details, "row": number}) from error

    def _trial(self, values: Mapping[str, Any]) -> Trial:
        measured = [values.get(name) for name in self.outcome]
        version, info = values.get("model_version"), values.get("info")
        return Trial.create(
            self.spec,
            id=_uuid(values["id"]),
            state=[values[name] for name in self.state],
            goal=[values[name] for name in self.goal],
            cost=None if _is_nan(values["cost"]) else values["cost"],
            success=values["success"],
            kind=values["kind"],
            outcome=None if all(value is None for value in measured) else measured,
            worker=values.get("worker"),
            model_version=None if version is None or _is_nan(version) else _whole(version),
            info=info_from_json(info) if info else None,
        )


def _by_coordinate(names: Sequence[str], rows: Sequence[Sequence[float | None]]) -> dict[str, list[Any]]:
    return {name: [row[place] for row in rows] for place, name in enumerate(names)}


def _numbers(trial: Trial, count: int) -> list[float | None]:
    """The outcome; none at all is told from numbers that were not observed, which are NaN."""
    return [None] * count if trial.outcome is None else list(trial.outcome.tolist())


def _uuid(value: object) -> UUID:
    try:
        return UUID(str(value))
    except ValueError as error:
        raise Invalid(f"id must be a UUID; got {value!r:.80}") from error


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _whole(value: object) -> object:
    """Spreadsheets and data frames make 3.0 of 3 where a column has gaps."""
    return int(value) if isinstance(value, float) and value.is_integer() else value
