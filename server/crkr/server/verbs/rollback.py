"""The verb rollback: an event that takes a task back to an earlier version of the policy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final
from uuid import UUID

from crkr.protocol import MAX_TRIALS, Invalid, TaskSpec, id_from_wire, pack
from crkr.protocol.checks import integer, required, text
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import CORRECTIONS, Event, LogReader, values_of
from crkr.server.verbs.admin import Change

__all__ = ["read_rollback"]

_MOST_BYTES: Final = 2**25  # of an event's values


def read_rollback(message: Mapping[str, Any], task: ServedTask, log: LogReader) -> Change:
    """The change that makes a task's policy the one of version `to` again.

    Trials, corrections and settings that came later no longer count. They stay in the log, and a rollback to a later
    version brings them back.

    Raises:
        Invalid: There is no such version, later corrections lack the former values, or they are too many.
    """
    to = integer(required(message, "to"), "to", low=1)
    if to > task.seq:
        raise Invalid(f"task {task.name!r} has no version {to}; its newest is {task.seq}")
    spec, corrected = _at(to, task, log)
    values = _different(corrected, to, task, log)
    body = {
        "to": to,
        "ids": list(values),
        "values": list(values.values()),
        "spec": replace(spec, name=task.name).to_dict(),
        "reason": text(message.get("reason", ""), "reason"),
    }
    return Change("rollback", body, lambda _task, _: {"to": to})


def _at(to: int, task: ServedTask, log: LogReader) -> tuple[TaskSpec, dict[bytes, dict[str, Any]]]:
    """The specification at a version, and of each trial that was ever corrected its values then."""
    visible = task.corrections.visible_at(to)
    spec = task.created
    values: dict[bytes, dict[str, Any]] = {}
    for event in log.events(task.name):  # one at a time: each may be large, and there may be many
        if event.kind == "create":
            spec = TaskSpec.from_dict(event.body["spec"])
        elif event.kind == "configure" and event.seq in visible:
            spec = spec.with_changes(event.body["changes"])
        elif event.kind in CORRECTIONS and "was" not in event.body:
            raise Invalid(
                f"task {task.name!r} cannot be rolled back: the {event.kind} at log position {event.seq}, by an "
                "earlier crkr, does not say what was before"
            )
        elif event.kind in CORRECTIONS:
            counts = event.seq in visible
            for identity, before, after in _changes(event):
                own = values.setdefault(identity, {})
                for name, value in before.items():
                    own.setdefault(name, value)
                if counts:
                    own.update(after)
    return spec, values


def _different(
    corrected: Mapping[bytes, Mapping[str, Any]], to: int, task: ServedTask, log: LogReader
) -> dict[UUID, dict[str, Any]]:
    """The trials whose values at a version are not today's, with those values."""
    found: dict[UUID, dict[str, Any]] = {}
    size, ids = 0, list(corrected)
    for first in range(0, len(ids), MAX_TRIALS):
        for trial in log.trials(task.name, [id_from_wire(one) for one in ids[first : first + MAX_TRIALS]]):
            then = {**values_of(trial), **corrected[trial["id"]]}
            packed = pack(then)
            if trial["seq"] <= to and packed != pack(task.corrections.values(trial)):  # bitwise: NaN is not itself
                found[id_from_wire(trial["id"])] = then
                size += len(packed)
        if size > _MOST_BYTES:
            raise Invalid(
                f"more than {len(found)} trials were corrected since version {to}, which is too much for one step: "
                "go back to a later version first"
            )
    return found


def _changes(event: Event) -> Iterator[tuple[bytes, Mapping[str, Any], Mapping[str, Any]]]:
    """The trials that a correction names, with the changed values before and after."""
    body = event.body
    for place, identity in enumerate(body["ids"]):
        was = body["was"][place]
        if event.kind == "amend":
            yield identity, was, body["values"][place]
        elif event.kind == "recost":
            yield identity, {"cost": was}, {"cost": body["costs"][place]}
        else:
            yield identity, {"removed": was}, {"removed": True}
