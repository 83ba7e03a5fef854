"""Administrative changes of a task, read and checked before anything is stored."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final
from uuid import UUID

from crkr.protocol import (
    MAX_TRIALS,
    Invalid,
    KernelSettings,
    Unsupported,
    check_model_fits,
    id_from_wire,
    refuse_absurd,
)
from crkr.protocol.checks import cost_number, finite_array, required, text
from crkr.protocol.codec import array_from_wire
from crkr.protocol.errors import shown
from crkr.protocol.specification.task_spec import CHANGEABLE
from crkr.server.learning.tasks import ServedTask, hyperparameters

__all__ = ["Change", "read_change"]

_KERNEL: Final = tuple(KernelSettings.__dataclass_fields__)


@final
@dataclass(frozen=True, slots=True)
class Change:
    """A change as an event to store.

    Attributes:
        kind: Kind of the event.
        body: Body of the event.
        answer: Makes the fields of the reply from the task and the learner's result.
        ids: Trials named, which must exist.
    """

    kind: str
    body: Mapping[str, Any]
    answer: Callable[[ServedTask, Any], dict[str, Any]]
    ids: Sequence[UUID] = ()


def read_change(verb: str, message: Mapping[str, Any], task: ServedTask) -> Change:
    """The change that a request asks for; raises `Invalid`, or `Unsupported` for an unknown verb."""
    read = _READERS.get(verb)
    if read is None:
        raise Unsupported(f"admin verb {verb!r} is not offered; these are: {', '.join(sorted(_READERS))}")
    return read(message, task)


def _recost(message: Mapping[str, Any], _task: ServedTask) -> Change:
    ids = _ids(message)
    costs = finite_array(array_from_wire(required(message, "costs"), "costs"), "costs", (len(ids),))
    values = [cost_number(cost, "costs") for cost in costs.tolist()]
    body = {"ids": ids, "costs": values, "reason": _reason(message)}
    return Change("recost", body, lambda _, changed: {"changed": int(changed)}, ids)


def _remove(message: Mapping[str, Any], _task: ServedTask) -> Change:
    ids = _ids(message)
    return Change("remove", {"ids": ids, "reason": _reason(message)}, lambda _, removed: {"removed": int(removed)}, ids)


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
    if "budget" in changes:  # a larger one from an earlier version stays valid until it is changed
        check_model_fits(changed_spec)
    understood = changed_spec.to_dict()
    stored = {name: _understood(value, understood[name]) for name, value in changes.items()}

    def answer(changed: ServedTask, _: Any) -> dict[str, Any]:
        return {"spec": changed.spec.to_dict(), "hyperparameters": hyperparameters(changed.model)}

    return Change("configure", {"changes": stored}, answer)


def _understood(given: Any, read: Any) -> Any:
    """A setting as it was read; of a group, the given fields. Unknown fields are not stored."""
    return {name: value for name, value in read.items() if name in given} if isinstance(read, Mapping) else read


def _archive(_message: Mapping[str, Any], _task: ServedTask) -> Change:
    return Change("archive", {}, lambda _task, _: {"archived": True})


def _ids(message: Mapping[str, Any]) -> list[UUID]:
    given = required(message, "ids")
    if not isinstance(given, list) or not 1 <= len(given) <= MAX_TRIALS:
        raise Invalid(f"ids must be a list of 1 to {MAX_TRIALS} ids")
    ids = [id_from_wire(one, "ids") for one in given]
    if len(set(ids)) != len(ids):
        raise Invalid("ids must differ; one comes twice")
    return ids


def _reason(message: Mapping[str, Any]) -> str:
    return text(message.get("reason", ""), "reason")


_READERS: Final[Mapping[str, Callable[[Mapping[str, Any], ServedTask], Change]]] = {
    "recost": _recost,
    "remove": _remove,
    "configure": _configure,
    "archive": _archive,
}
