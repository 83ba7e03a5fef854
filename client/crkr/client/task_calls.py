"""Calls of `Task` that may take several messages: the look-up of a specification, and many predictions."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Final

from crkr.client.checks import answer_to
from crkr.client.rpc import Rpc
from crkr.protocol import Array, NovelState, Prediction, TaskSpec, UnknownTask, Unsupported, task_key
from crkr.protocol.checks import required

__all__ = ["ask", "ask_in_parts", "look_up"]

_MOST_NAMED: Final = 20  # tasks named in an error


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
    with answer_to("spec"):
        return TaskSpec.from_dict(required(found, "spec")), found.get("archived") is True


def _listed(rpc: Rpc, name: str, deadline: float) -> Mapping[str, Any]:
    """The task's entry in the list of all tasks."""
    names: list[str] = []
    for page in rpc.task_pages(deadline):
        with answer_to("tasks"):
            entries: dict[str, Mapping[str, Any]] = {entry["spec"]["name"]: entry for entry in page}
            if name in entries:
                return entries[name]
            names += sorted(entries)
    listed = ", ".join(names[:_MOST_NAMED]) or "none"
    raise UnknownTask(
        f"no task {name!r} at {rpc.transport.endpoint}; it has: {listed}; crkr create makes one", details={"task": name}
    )


def ask(rpc: Rpc, task: str, states: Array, message: Mapping[str, Any], timeout_s: float | None) -> Prediction:
    """Sends one message of `PredictRequest.to_wire` about these states and returns the answer."""
    reply = rpc.call(task_key(task, "predict"), message, timeout_s)
    with answer_to("predict"):
        return Prediction.from_wire(reply, states)


def ask_in_parts(
    rpc: Rpc, task: str, states: Array, message: Mapping[str, Any], most: int, timeout_s: float | None
) -> Prediction:
    """As `ask`, with at most `most` states a message and one deadline for all.

    Raises:
        NovelState: A state is more novel than the task allows; its index is that among all states.
        CrkrError: The error of any one message.
    """
    deadline, parts = rpc.deadline(timeout_s), []
    for start in range(0, len(states), most):
        end = min(start + most, len(states))
        part = {**message, "states": states[start:end], "trial_ids": message["trial_ids"][start:end]}
        try:
            parts.append(ask(rpc, task, states[start:end], part, max(deadline - time.monotonic(), 0.001)))
        except NovelState as error:
            index = error.details.get("index")
            where = {"index": start + index} if isinstance(index, int) else {}
            told = f"among states {start} to {end - 1}: {error.message}"
            raise NovelState(told, details={**error.details, **where}) from error
    return Prediction.joined(parts)
