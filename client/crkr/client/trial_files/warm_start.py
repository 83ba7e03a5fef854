"""Trials of one task as the first ones of another, whose specification differs: columns are mapped by name."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final
from uuid import UUID

import numpy as np

from crkr.client.task import Task
from crkr.client.trial_files.layout import FileRow
from crkr.client.trial_files.trial_import import import_rows
from crkr.protocol import Array, Invalid, StoredTrial, TaskSpec, Trial, task_id

__all__ = ["WarmStartReport", "warm_start"]

_NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SOURCE: Final = re.compile(
    rf"\s*(?:(?P<factor>{_NUMBER})\s*\*\s*)?(?P<column>(?:state|goal|outcome)\.[^\s*+]+)\s*(?P<offset>[-+]\s*{_NUMBER})?\s*"
)


@final
@dataclass(frozen=True, slots=True)
class WarmStartReport:
    """Counts of the other task's trials.

    Attributes:
        accepted: New to the task.
        duplicates: Stored already, by an earlier warm start.
        skipped: Removed, evaluations, or outside the bounds of the task's goals.
    """

    accepted: int
    duplicates: int
    skipped: int


@final
@dataclass(frozen=True, slots=True)
class _Term:
    """A number of a new trial: factor * column + offset; column -1 means no column."""

    column: int
    factor: float
    offset: float


def warm_start(
    task: Task,
    source: Task,
    columns: Mapping[str, str | float] | None = None,
    *,
    timeout_s: float = 60.0,
    progress: Callable[[int], None] = lambda _: None,
) -> WarmStartReport:
    """Reports the trials of another task to this one, under ids of their own: repeating it stores nothing twice.

    Coordinates of the same name, costs and successes are copied; removed trials, evaluations and goals outside the
    bounds are not.

    Args:
        task: The task to start; it exists.
        source: The task with the trials.
        columns: Coordinate of the task, as "goal.speed" -> where it comes from: "goal.v", "0.01 * goal.v + 2" or a
            number. An outcome without a source is not observed.
        timeout_s: Deadline of each batch [s].
        progress: Called with the number of trials stored so far.

    Raises:
        Invalid: A coordinate has no source, or a source cannot be read.
    """
    terms = _terms(task.spec, source.spec, dict(columns or {}))
    counted = [0]
    done = import_rows(task, _rows(task, source, terms, counted), timeout_s, progress)
    return WarmStartReport(done.accepted, done.duplicates, counted[0])


def _rows(task: Task, source: Task, terms: Mapping[str, Sequence[_Term]], skipped: list[int]) -> Iterator[FileRow]:
    low, high = task.spec.bounds
    for number, stored in enumerate(source.iter_samples(), 1):
        trial = stored.trial
        goal = _mapped(terms["goal"], stored)
        if stored.removed or trial.kind == "evaluation" or (goal < low).any() or (goal > high).any():
            skipped[0] += 1
            continue
        yield FileRow(number, _trial(task, source, trial.id, stored, goal, terms), removed=False)


def _trial(
    task: Task, source: Task, identity: UUID, stored: StoredTrial, goal: Array, terms: Mapping[str, Sequence[_Term]]
) -> Trial:
    old = stored.trial
    return Trial.create(
        task.spec,
        id=task_id(task.name, f"from/{source.name}/{identity}"),
        state=_mapped(terms["state"], stored),
        goal=goal,
        cost=old.cost,
        success=old.success,
        kind=old.kind,
        outcome=_mapped(terms["outcome"], stored) if terms["outcome"] else None,
        worker=f"from {source.name}"[:128],
        info={"from": {"task": source.name, "id": str(identity)}},
        learn=old.learn,
    )


def _mapped(terms: Sequence[_Term], stored: StoredTrial) -> Array:
    trial = stored.trial
    outcome = [] if trial.outcome is None else trial.outcome.tolist()
    numbers = np.array([*trial.state, *trial.goal, *outcome, np.nan])  # the last where nothing was measured
    last = len(numbers) - 1
    return np.array(
        [term.offset + (term.factor * numbers[min(term.column, last)] if term.column >= 0 else 0.0) for term in terms]
    )


def _terms(spec: TaskSpec, old: TaskSpec, columns: dict[str, str | float]) -> dict[str, list[_Term]]:
    """The source of each coordinate of the task."""
    there = [
        *(f"state.{axis.name}" for axis in old.state),
        *(f"goal.{axis.name}" for axis in old.goal),
        *(f"outcome.{entry.name}" for entry in old.outcome),
    ]
    found: dict[str, list[_Term]] = {}
    for group, axes in (("state", spec.state), ("goal", spec.goal), ("outcome", spec.outcome)):
        found[group] = []
        for axis in axes:
            name = f"{group}.{axis.name}"
            given = columns.pop(name, name if name in there else None)
            if given is None and group != "outcome":
                raise Invalid(
                    f"{name} of task {spec.name!r} has no source; map it, as {name}={there[0]} or {name}=0.5; "
                    f"task {old.name!r} has {', '.join(there)}"
                )
            found[group].append(_Term(-1, 0.0, np.nan) if given is None else _term(name, given, there))
    if columns:
        raise Invalid(f"task {spec.name!r} has no coordinate {next(iter(columns))!r}")
    return found


def _term(name: str, given: str | float, there: Sequence[str]) -> _Term:
    if isinstance(given, int | float):
        return _Term(-1, 0.0, float(given))
    if re.fullmatch(_NUMBER, given.strip()):
        return _Term(-1, 0.0, float(given))
    match = _SOURCE.fullmatch(given)
    if match is None or match["column"] not in there:
        raise Invalid(
            f"{name} cannot come from {given!r}; it takes a number, one of {', '.join(there)}, or 2 * {there[0]} + 1"
        )
    factor, offset = match["factor"] or "1", (match["offset"] or "0").replace(" ", "")
    return _Term(there.index(match["column"]), float(factor), float(offset))
