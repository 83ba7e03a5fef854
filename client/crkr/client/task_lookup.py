"""A task's specification by its name, whatever else the server has and however old it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from crkr.client.network.rpc import Rpc, reading
from crkr.protocol import TaskSpec, UnknownTask, Unsupported, task_key
from crkr.protocol.checks import required

__all__ = ["look_up"]

_MOST_NAMED: Final = 20  # tasks that an error tells of


def look_up(rpc: Rpc, name: str, timeout_s: float | None) -> tuple[TaskSpec, bool]:
    """The specification in force, and whether the task is archived.

    Raises:
        UnknownTask: The server has no such task.
        Unavailable: No answer by the deadline.
    """
    deadline = rpc.deadline(timeout_s)
    found: Mapping[str, Any]
    try:
        found = rpc.call(task_key(name, "spec"), {}, timeout_s, optional=True)
    except Unsupported:  # a server of version 0.1, or access control that was set up for one
        found = _listed(rpc, name, deadline)
    with reading("spec"):
        return TaskSpec.from_dict(required(found, "spec")), found.get("archived") is True


def _listed(rpc: Rpc, name: str, deadline: float) -> Mapping[str, Any]:
    """The task's entry in the list of all."""
    names: list[str] = []
    for page in rpc.task_pages(deadline):
        with reading("tasks"):
            entries: dict[str, Mapping[str, Any]] = {entry["spec"]["name"]: entry for entry in page}
            if name in entries:
                return entries[name]
            names += sorted(entries)
    listed = ", ".join(names[:_MOST_NAMED]) or "none"
    raise UnknownTask(
        f"no task {name!r} at {rpc.transport.endpoint}; it has: {listed}; crkr create makes one", details={"task": name}
    )
