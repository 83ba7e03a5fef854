"""Becoming part of a task: creating it, or joining the one that is there."""

from __future__ import annotations

from collections.abc import Callable

from crkr.client import Client, Task
from crkr.protocol import Conflict, TaskSpec

__all__ = ["create_or_join"]


def create_or_join(client: Client, spec: TaskSpec, say: Callable[[str], None]) -> Task:
    """The task of this specification; one that differs in its seed only is joined and keeps its seed.

    Args:
        client: Where.
        spec: What is to be learned.
        say: Prints a line for people.

    Raises:
        Conflict: The task exists and learns something else; the message names the fields.
    """
    try:
        return client.create_task(spec)
    except Conflict as conflict:
        fields = conflict.details.get("fields")
        if not isinstance(fields, dict) or not fields:
            raise
        if set(fields) == {"seed"}:
            task = client.task(spec.name)
            say(f"task {spec.name} exists and keeps its seed {task.spec.seed}")
            return task
        listed = ", ".join(sorted(fields))
        raise Conflict(
            f"task {spec.name!r} exists with another specification; these fields differ: {listed}; "
            "choose another name with --task, or the options it was created with",
            details=conflict.details,
        ) from conflict
