"""Becoming part of a task: creating it, or joining the one that is there."""

from __future__ import annotations

import logging

from crkr.client import Client, Task
from crkr.protocol import Conflict, TaskSpec

__all__ = ["create_or_join"]

logger = logging.getLogger(__name__)


def create_or_join(client: Client, spec: TaskSpec) -> Task:
    """The task of this specification; one that differs in its seed only is joined and keeps its seed.

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
            logger.info("task %s keeps its seed %s", spec.name, fields["seed"][0])
            return client.task(spec.name)
        listed = ", ".join(sorted(fields))
        raise Conflict(
            f"task {spec.name!r} exists with another specification; these fields differ: {listed}; "
            "choose another name with --task, or the options it was created with",
            details=conflict.details,
        ) from conflict
