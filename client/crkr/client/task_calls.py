"""Calls of `Task` that may take several messages: the look-up of a specification, many predictions, and many trials."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final
from uuid import UUID

from crkr.client.checks import answer_to
from crkr.client.rpc import Rpc
from crkr.protocol import Array, NovelState, Prediction, StoredTrial, TaskSpec, UnknownTask, Unsupported, task_key
from crkr.protocol.checks import entries, integer, required

__all__ = ["ask", "ask_in_parts", "look_up", "named_trials", "newest_trials", "worst_trials"]

_MOST_NAMED: Final = 20  # tasks named in an error
_PAGE: Final = 1000  # trials


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
            summaries: dict[str, Mapping[str, Any]] = {entry["spec"]["name"]: entry for entry in page}
            if name in summaries:
                return summaries[name]
            names += sorted(summaries)
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


def named_trials(
    rpc: Rpc, task: str, spec: TaskSpec, ids: Sequence[UUID], timeout_s: float | None
) -> list[StoredTrial]:
    """Stored trials by their ids, in the order asked.

    Raises:
        Invalid: An unknown id.
        Unsupported: The server is too old to be asked by id.
    """
    reply = rpc.call(task_key(task, "samples"), {"id": list(ids), "limit": len(ids)}, timeout_s)
    found = _stored(reply, spec)
    if [one.trial.id for one in found] != list(ids):
        raise Unsupported("the server is of an earlier version, which finds no trials by id; read them by iter_samples")
    return found


def newest_trials(rpc: Rpc, task: str, spec: TaskSpec, count: int, timeout_s: float | None) -> list[StoredTrial]:
    """The newest `count` trials, newest first.

    Raises:
        Unsupported: The server is too old to be asked backwards.
    """
    found: list[StoredTrial] = []
    before: int | None = None
    while len(found) < count:
        message: dict[str, Any] = {"last": min(count - len(found), _PAGE)}
        reply = rpc.call(
            task_key(task, "samples"), message if before is None else {**message, "before": before}, timeout_s
        )
        if reply.get("backwards") is not True:
            raise Unsupported("the server is of an earlier version, which reads trials forwards only: use iter_samples")
        found += _stored(reply, spec)
        with answer_to("samples"):
            if reply.get("next") is None:
                break
            before = integer(reply["next"], "next")
    return found


def worst_trials(
    page: Callable[..., tuple[list[StoredTrial], int | None]], count: int, timeout_s: float | None
) -> list[StoredTrial]:
    """The `count` trials of highest cost that are not removed, worst first; the newer of equal ones first."""
    worst: list[StoredTrial] = []
    after: int | None = 0
    while after is not None:
        found, after = page(after, timeout_s=timeout_s)
        worst = heapq.nlargest(count, [*worst, *_with_cost(found)], key=lambda one: (one.trial.cost, one.seq))
    return worst


def _with_cost(found: Iterable[StoredTrial]) -> list[StoredTrial]:
    return [one for one in found if one.trial.cost is not None and not one.removed]


def _stored(reply: Mapping[str, Any], spec: TaskSpec) -> list[StoredTrial]:
    with answer_to("samples"):
        return [StoredTrial.from_wire(entry, spec) for entry in entries(reply, "samples")]
