"""Becoming part of a task: creating it, or joining the one that is there."""

from __future__ import annotations

from collections.abc import Callable

from crkr.client import Client, Task
from crkr.protocol import Conflict, TaskSpec

__all__ = ["create_or_join"]


def create_or_join(client: Client, spec: TaskSpec, say: Callable[[str], None], *, its_settings: bool = False) -> Task:
    """The task of this specification; one that differs in its seed only is joined and keeps its seed.

    Args:
        client: Where.
        spec: What is to be learned.
        say: Prints a line for people.
        its_settings: A task that is there may learn by other settings, as long as states, goals and outcomes are the
            same: somebody edited its specification.

    Raises:
        Conflict: The task exists and learns something else; the message names the fields.
    """
    try:
        return client.create_task(spec)
    except Conflict as conflict:
        fields = conflict.details.get("fields")
        if not isinstance(fields, dict) or not fields:
            raise
        task = client.task(spec.name)
        if set(fields) == {"seed"}:
            say(f"task {spec.name} exists and keeps its seed {task.spec.seed}")
            return task
        if its_settings and _axes(task.spec) == _axes(spec):
            say(f"task {spec.name} exists and keeps its own {', '.join(sorted(fields))}")
            return task
        listed = ", ".join(sorted(fields))
        raise Conflict(
            f"task {spec.name!r} exists with another specification; these fields differ: {listed}; "
            "choose another name with --task, or the options it was created with",
            details=conflict.details,
        ) from conflict


def _axes(spec: TaskSpec) -> list[object]:
    """What a trial's numbers mean, and where they may lie; scales and targets are settings."""
    boxes = [[(axis.name, axis.unit, axis.low, axis.high) for axis in axes] for axes in (spec.state, spec.goal)]
    return [*boxes, [(entry.name, entry.unit) for entry in spec.outcome]]
