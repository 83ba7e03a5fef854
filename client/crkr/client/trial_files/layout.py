"""Trials as rows of named columns, the same in every kind of file."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, Final, Literal, final
from uuid import UUID

from crkr.client.trial_files.info_json import info_to_json, reported_info
from crkr.protocol import Invalid, StoredTrial, TaskSpec, Trial
from crkr.protocol.checks import flag, shown

__all__ = ["ColumnType", "FileRow", "Layout"]

ColumnType = Literal["int", "float", "text", "flag"]

_REQUIRED: Final[Mapping[str, ColumnType]] = {"id": "text", "kind": "text", "success": "flag", "cost": "float"}
# The server's own; an import ignores them and gets new ones.
_WRITTEN: Final[Mapping[str, ColumnType]] = {"seq": "int", "time": "float"}
_OPTIONAL: Final[Mapping[str, ColumnType]] = {
    "worker": "text",
    "model_version": "int",
    "removed": "flag",
    "learn": "int",  # 1, 0, or empty where the task decides
    "info": "text",
}
_NUMBER: Final = re.compile(
    r"[-+]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:e[-+]?\d+)?|nan|inf(?:inity)?)", re.ASCII | re.IGNORECASE
)
_WHOLE: Final = re.compile(r"[-+]?\d+", re.ASCII)
_LONGEST_NUMBER: Final = 400  # characters
_GAPS: Final = ("", "na", "<na>", "null")  # as R, pandas and databases write them in columns of numbers and flags
_FLAGS: Final = {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}


@final
@dataclass(frozen=True, slots=True)
class FileRow:
    """One trial of a file.

    Attributes:
        number: The row's number, from 1.
        trial: The trial, with its cost at the time of writing.
        removed: Whether it had been removed from the model.
        packed: Whether its `info` is valid only in an earlier version; it is kept as bytes.
    """

    number: int
    trial: Trial
    removed: bool
    packed: bool = False


@final
class Layout:
    """The columns of one task's files: a trial's fields, and `state.<name>`, `goal.<name>`, `outcome.<name>`.

    Attributes:
        spec: The task.
        state: Names of its d columns.
        goal: Names of its p columns.
        outcome: Names of its q columns.
        types: Every column that is written, with the type of its values; any may be empty.
        read: The columns that are read.
    """

    def __init__(self, spec: TaskSpec) -> None:
        self.spec: Final = spec
        self.state: Final = tuple(f"state.{axis.name}" for axis in spec.state)
        self.goal: Final = tuple(f"goal.{axis.name}" for axis in spec.goal)
        self.outcome: Final = tuple(f"outcome.{entry.name}" for entry in spec.outcome)
        numbers: dict[str, ColumnType] = dict.fromkeys((*self.state, *self.goal, *self.outcome), "float")
        self.read: Final[Mapping[str, ColumnType]] = {**_REQUIRED, **numbers, **_OPTIONAL}
        self.types: Final[Mapping[str, ColumnType]] = {**_REQUIRED, **numbers, **_WRITTEN, **_OPTIONAL}

    def check(self, found: Collection[str]) -> None:
        """Checks a file's columns; unknown ones are ignored.

        Raises:
            Invalid: A column is missing or comes twice, or is a coordinate that the task does not have.
        """
        missing = [name for name in (*_REQUIRED, *self.state, *self.goal) if name not in found]
        if missing:
            raise Invalid(f"column {missing[0]!r} is missing; there are: {', '.join(found) or 'none'}")
        twice = [name for name, times in Counter(list(found)).items() if times > 1 and name in self.read]
        if twice:
            raise Invalid(f"column {twice[0]!r} comes twice; leave one out")
        for name in found:
            if name.startswith(("state.", "goal.", "outcome.")) and name not in self.types:
                raise Invalid(f"column {name!r} is not a coordinate of task {self.spec.name!r}")

    def columns(self, stored: Sequence[StoredTrial]) -> dict[str, list[Any]]:
        """Values by column, None where a trial has no value."""
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
            "learn": [None if trial.learn is None else int(trial.learn) for trial in trials],
            "info": [info_to_json(trial.info) if trial.info else None for trial in trials],
        }

    def row(self, number: int, values: Mapping[str, Any]) -> FileRow:
        """Checks one row's values by column.

        Raises:
            Invalid: A value that a trial of the task cannot have; the message names row and column.
        """
        try:
            cells = {name: _cell(name, kind, values.get(name)) for name, kind in self.read.items()}
            info, packed = reported_info(cells["info"] or "")
            removed = cells["removed"]
            return FileRow(number, self._trial(cells, info), removed is not None and flag(removed, "removed"), packed)
        except Invalid as error:
            separator = "" if error.message.startswith(", column") else ": "
            details = {**error.details, "row": number}
            raise Invalid(f"row {number}{separator}{error.message}", details=details) from error

    def parsed(self, number: int, name: str, text: str | None) -> object:
        """The value of a text cell; None for an empty cell, except in columns of text.

        Raises:
            Invalid: It is not of the column's type; the message names row and column.
        """
        kind = self.read[name]
        if text is None or kind == "text":
            return text
        word = text.strip()
        if word.lower() in _GAPS:
            return None
        if kind == "flag" and word.lower() in _FLAGS:
            return _FLAGS[word.lower()]
        if kind == "int" and len(word) <= _LONGEST_NUMBER and _WHOLE.fullmatch(word):
            return int(word)
        if kind != "flag" and len(word) <= _LONGEST_NUMBER and _NUMBER.fullmatch(word):
            return float(word)
        wanted = "true or false" if kind == "flag" else "a number"
        raise Invalid(f"row {number}, column {name!r}: must be {wanted}; got {shown(text)}", details={"row": number})

    def _trial(self, cells: Mapping[str, Any], info: Mapping[str, Any]) -> Trial:
        for name in (*self.state, *self.goal):
            if cells[name] is None:
                raise Invalid(f"{name.partition('.')[0]} must be finite; column {name!r} is empty")
        measured = [cells[name] for name in self.outcome]
        return Trial.create(
            self.spec,
            id=_uuid(cells["id"]),
            state=[cells[name] for name in self.state],
            goal=[cells[name] for name in self.goal],
            cost=cells["cost"],
            success=cells["success"],
            kind=cells["kind"],
            outcome=None if all(value is None for value in measured) else measured,
            worker=cells["worker"],
            model_version=cells["model_version"],
            info=info,
            learn=_cell("learn", "flag", cells["learn"]),
        )


def _by_coordinate(names: Sequence[str], rows: Sequence[Sequence[float | None]]) -> dict[str, list[Any]]:
    return {name: [row[place] for row in rows] for place, name in enumerate(names)}


def _numbers(trial: Trial, count: int) -> list[float | None]:
    """The outcome; None for a trial without one, NaN for numbers that were not observed."""
    return [None] * count if trial.outcome is None else list(trial.outcome.tolist())


def _cell(name: str, kind: ColumnType, value: Any) -> Any:
    """A value in its column's type. Data frames turn 3 and truth values into floats, and gaps into NaN.

    Raises:
        Invalid: It has another type; the message names the column.
    """
    if type(value) is float and value == value and kind == "float":  # nearly every cell
        return value
    if isinstance(value, Decimal):
        value = float(value)
    if kind == "flag":
        return bool(value) if isinstance(value, int | float) and value in (0, 1) else value
    if isinstance(value, float) and math.isnan(value) and not name.startswith("outcome."):
        return None
    if value is None or name == "id":
        return value
    if kind == "text":
        if not isinstance(value, str):
            raise Invalid(f", column {name!r}: must be text; got {shown(value)}")
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise Invalid(f", column {name!r}: must be a number; got {shown(value)}")
    elif kind == "int" and isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def _uuid(value: object) -> UUID:
    try:
        if isinstance(value, UUID):
            return value
        if isinstance(value, bytes):
            return UUID(bytes=value) if len(value) == 16 else UUID(value.decode())
        if isinstance(value, str):
            return UUID(value)
    except ValueError:
        pass
    raise Invalid(f"id must be a UUID; got {shown(value)}", details={"field": "id"})
