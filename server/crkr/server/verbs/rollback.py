"""The verb rollback: an event that takes a task back to an earlier version of the policy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any
from uuid import UUID

from crkr.protocol import Invalid, TaskSpec, id_from_wire
from crkr.protocol.checks import integer, required, text
from crkr.server.learning.tasks import ServedTask
from crkr.server.log import CORRECTIONS, Event, LogReader, Visible, values_of
from crkr.server.verbs.admin import Change

__all__ = ["read_rollback"]


def read_rollback(message: Mapping[str, Any], task: ServedTask, log: LogReader) -> Change:
    """The change that makes a task's policy the one of version `to` again.

    Trials, corrections and settings that came later no longer count. They stay in the log, and a rollback to a later
    version brings them back.

    Raises:
        Invalid: There is no such version, or later corrections lack the former values.
    """
    to = integer(required(message, "to"), "to", low=1)
    if to > task.seq:
        raise Invalid(f"task {task.name!r} has no version {to}; its newest is {task.seq}")
    events = list(log.events(task.name))
    visible = Visible.of(events, to)
    values = _values(events, visible, to, task, log)
    spec = replace(_spec(events, visible), name=task.name)
    body = {
        "to": to,
        "ids": list(values),
        "values": list(values.values()),
        "spec": spec.to_dict(),
        "reason": text(message.get("reason", ""), "reason"),
    }
    return Change("rollback", body, lambda _task, _: {"to": to})


def _spec(events: list[Event], visible: Visible) -> TaskSpec:
    """The specification in force at a version."""
    spec = TaskSpec.from_dict(events[0].body["spec"])
    for event in events:
        if event.kind == "configure" and event.seq in visible:
            spec = spec.with_changes(event.body["changes"])
    return spec


def _values(
    events: list[Event], visible: Visible, to: int, task: ServedTask, log: LogReader
) -> dict[UUID, dict[str, Any]]:
    """Values at a version of each earlier trial that was ever corrected."""
    first: dict[bytes, dict[str, Any]] = {}
    then: dict[bytes, dict[str, Any]] = {}
    for event in events:
        if event.kind not in CORRECTIONS:
            continue
        if "was" not in event.body:
            raise Invalid(
                f"task {task.name!r} cannot be rolled back: the {event.kind} at log position {event.seq}, by an "
                "earlier crkr, does not say what was before"
            )
        for identity, before, after in _changes(event):
            first.setdefault(identity, {})
            for name, value in before.items():
                first[identity].setdefault(name, value)
            if event.seq in visible:
                then.setdefault(identity, {}).update(after)
    found = log.trials(task.name, [id_from_wire(one) for one in first])
    return {
        id_from_wire(trial["id"]): {**values_of(trial), **first[trial["id"]], **then.get(trial["id"], {})}
        for trial in found
        if trial["seq"] <= to
    }


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
