"""Administrative changes of a task, read and checked before anything is stored."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias, final
from uuid import UUID, uuid4

from crkr.protocol import (
    AmendRequest,
    Invalid,
    KernelSettings,
    StoredTrial,
    Unsupported,
    check_model_fits,
    check_name,
    id_from_wire,
    pack,
    refuse_absurd,
    trial_ids,
)
from crkr.protocol.checks import cost_number, finite_array, required, text
from crkr.protocol.codec import array_from_wire
from crkr.protocol.errors import shown
from crkr.protocol.specification.task_spec import CHANGEABLE
from crkr.server.learning.served_task import ServedTask, hyperparameters
from crkr.server.log import DELETED, Event, values_of

__all__ = ["Answer", "Change", "amendment", "moved", "read_change", "refuse_unknown", "removal"]

Answer: TypeAlias = Callable[[ServedTask, Any], dict[str, Any]]
"""Fields of a reply, from the task and the learner's result."""

_KERNEL: Final = tuple(KernelSettings.__dataclass_fields__)


@final
@dataclass(frozen=True, slots=True)
class Change:
    """A change as an event to store.

    Attributes:
        kind: Kind of the event.
        body: Body of the event.
        answer: Makes the fields of the reply.
        ids: Trials that must exist.
        complete: Makes the body from the current values of the named trials; None: no change, and no event is stored.
    """

    kind: str
    body: Mapping[str, Any]
    answer: Answer
    ids: Sequence[UUID] = ()
    complete: Callable[[Sequence[Mapping[str, Any]]], Mapping[str, Any] | None] | None = None


def read_change(verb: str, message: Mapping[str, Any], task: ServedTask) -> Change:
    """Reads the change of a request; raises `Invalid`, or `Unsupported` for an unknown verb."""
    read = _READERS.get(verb)
    if read is None:
        raise Unsupported(f"admin verb {verb!r} is not offered; these are: {', '.join(sorted(_READERS))}")
    return read(message, task)


def _recost(message: Mapping[str, Any], _task: ServedTask) -> Change:
    ids = trial_ids(required(message, "ids"))
    costs = finite_array(array_from_wire(required(message, "costs"), "costs"), "costs", (len(ids),))
    values = [cost_number(cost, "costs") for cost in costs.tolist()]
    body = {"ids": list(ids), "costs": values, "reason": _reason(message)}

    def complete(present: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        return {**body, "was": [trial["cost"] for trial in present]}

    return Change("recost", body, lambda _, changed: {"changed": int(changed)}, ids, complete)


def _remove(message: Mapping[str, Any], _task: ServedTask) -> Change:
    ids = trial_ids(required(message, "ids"))
    return removal(ids, {"reason": _reason(message)}, lambda _, removed: {"removed": int(removed)})


def removal(ids: Sequence[UUID], body: Mapping[str, Any], answer: Answer) -> Change:
    """The removal of trials; the event names those that were removed before."""

    def complete(present: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        return {"ids": list(ids), **body, "was": [trial.get("removed", False) for trial in present]}

    return Change("remove", {"ids": list(ids), **body}, answer, ids, complete)


def amendment(
    ids: Sequence[UUID],
    now: Callable[[Mapping[str, Any], int], Mapping[str, Any]],
    body: Mapping[str, Any],
    answer: Answer,
) -> Change:
    """New values for trials.

    Args:
        ids: The trials.
        now: Function of a trial and its position, which returns the new values.
        body: Further fields of the event.
        answer: Makes the fields of the reply.
    """

    def complete(present: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
        was = [values_of(trial) for trial in present]
        values = [now(trial, place) for place, trial in enumerate(present)]
        if "undoes" not in body and pack({"values": values}) == pack({"values": was}):  # bitwise: NaN is not itself
            return None
        return {"ids": list(ids), **body, "values": values, "was": was}

    return Change("amend", body, answer, ids, complete)


def _amend(message: Mapping[str, Any], task: ServedTask) -> Change:
    asked = AmendRequest.from_wire(message)

    def now(trial: Mapping[str, Any], _place: int) -> Mapping[str, Any]:
        if trial.get("removed") and not asked.restore:
            raise Invalid(f"trial {id_from_wire(trial['id'])} is removed; amend it with restore to learn from it again")
        amended = StoredTrial.from_wire(trial, task.created).trial.amended(task.created, asked.changes)
        return values_of(amended.to_wire())

    return amendment(asked.ids, now, {"reason": asked.reason}, lambda _, changed: {"changed": int(changed or 0)})


def _configure(message: Mapping[str, Any], task: ServedTask) -> Change:
    changes = required(message, "changes")
    if not isinstance(changes, Mapping) or not changes:
        raise Invalid(f"changes must be a map with at least one field; got {type(changes).__name__}")
    if len(changes) > len(CHANGEABLE):
        raise Invalid(f"changes has {len(changes)} fields; these can be changed: {', '.join(CHANGEABLE)}")
    kernel = changes.get("kernel")
    if isinstance(kernel, Mapping) and (unknown := [key for key in kernel if key not in _KERNEL]):
        named = ", ".join(shown(key) for key in unknown[:5])
        raise Invalid(f"unknown fields in kernel: {named}; known are {', '.join(_KERNEL)}")
    changed_spec = task.agreed.with_changes(changes)
    refuse_absurd(changed_spec, task.agreed)
    if "budget" in changes:  # a larger one of an earlier version stays until it is changed
        check_model_fits(changed_spec)
    understood = changed_spec.to_dict()
    stored = {name: _understood(value, understood[name]) for name, value in changes.items()}

    def answer(changed: ServedTask, _: Any) -> dict[str, Any]:
        return {"spec": changed.spec.to_dict(), "hyperparameters": hyperparameters(changed.model)}

    return Change("configure", {"changes": stored}, answer)


def _understood(given: Any, read: Any) -> Any:
    """A setting as it was read; for a group, its given fields. Unknown fields are not stored."""
    return {name: value for name, value in read.items() if name in given} if isinstance(read, Mapping) else read


def _archive(_message: Mapping[str, Any], _task: ServedTask) -> Change:
    return Change("archive", {}, lambda _task, _: {"archived": True})


def _rename(message: Mapping[str, Any], task: ServedTask) -> Change:
    name = check_name(required(message, "name"), "new task name")
    return _move("rename", name, message, task)


def _delete(message: Mapping[str, Any], task: ServedTask) -> Change:
    return _move("delete", f"{DELETED}{task.name}/{task.seq}-{uuid4().hex[:8]}", message, task)


def _move(kind: str, name: str, message: Mapping[str, Any], task: ServedTask) -> Change:
    body: dict[str, Any] = {"name": name}
    if message.get("request") is not None:  # earlier clients send none
        body |= {"was": task.name, "request": id_from_wire(message["request"], "request").bytes}
    return Change(kind, body, lambda _task, _: _moved_to(kind, name))


def moved(event: Event) -> dict[str, Any]:
    """The answer to a repeated rename or delete."""
    return {**_moved_to(event.kind, event.body["name"]), "seq": event.seq, "model_version": event.seq}


def _moved_to(kind: str, name: str) -> dict[str, Any]:
    return {"name": name} if kind == "rename" else {"deleted": True}


def refuse_unknown(task: str, ids: Sequence[UUID], found: Sequence[Mapping[str, Any]]) -> None:
    """Raise `Invalid` if some of the ids are not among the trials that were found."""
    known = {trial["id"] for trial in found}
    if missing := [one for one in ids if one.bytes not in known]:
        listed = ", ".join(str(one) for one in missing[:5])
        raise Invalid(
            f"task {task!r} has no trial with {'this id' if len(missing) == 1 else 'these ids'}: {listed}",
            details={"missing": [str(one) for one in missing]},
        )


def _reason(message: Mapping[str, Any]) -> str:
    return text(message.get("reason", ""), "reason")


_READERS: Final[Mapping[str, Callable[[Mapping[str, Any], ServedTask], Change]]] = {
    "recost": _recost,
    "remove": _remove,
    "amend": _amend,
    "configure": _configure,
    "rename": _rename,
    "archive": _archive,
    "delete": _delete,
}
