"""Requests that correct stored trials, and that undo the newest change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final
from uuid import UUID

from crkr.protocol.checks import choice, cost_number, flag, refuse_masked, required, text
from crkr.protocol.codec import MAX_TRIALS, frozen_from_wire, id_from_wire
from crkr.protocol.earlier_python import Self
from crkr.protocol.errors import Invalid
from crkr.protocol.trial import AMENDABLE, KINDS

__all__ = ["AmendRequest", "UndoRequest", "trial_ids"]


def trial_ids(value: object) -> tuple[UUID, ...]:
    """Ids of stored trials, each once; raises `Invalid`."""
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= MAX_TRIALS:
        raise Invalid(f"ids must be a list of 1 to {MAX_TRIALS} ids")
    ids = tuple(id_from_wire(one, "ids") for one in value)
    if len(set(ids)) != len(ids):
        raise Invalid("ids must differ; one comes twice")
    return ids


@final
@dataclass(frozen=True, slots=True, eq=False)
class AmendRequest:
    """New values for stored trials, the same for all of them.

    Attributes:
        ids: 1 to 1024 trials.
        changes: Some of `success`, `cost`, `outcome` (q,), `kind` and `learn`.
        restore: Learn from removed trials again.
        reason: Kept in the log.
    """

    ids: tuple[UUID, ...]
    changes: Mapping[str, Any]
    restore: bool = False
    reason: str = ""

    @classmethod
    def create(
        cls,
        ids: Sequence[UUID | bytes],
        *,
        success: object = None,
        cost: object = None,
        outcome: object = None,
        kind: object = None,
        learn: object = None,
        restore: object = False,
        reason: object = "",
    ) -> Self:
        """Checks a correction; None leaves a value as it is.

        Raises:
            Invalid: A value that no task allows, or no change at all.
        """
        changes: dict[str, Any] = {}
        if success is not None:
            changes["success"] = flag(success, "success")
        if cost is not None:
            changes["cost"] = cost_number(cost, "cost")
        if outcome is not None:
            refuse_masked(outcome, "outcome")
            changes["outcome"] = frozen_from_wire(outcome, "outcome")
        if kind is not None:
            changes["kind"] = choice(kind, "kind", KINDS)
        if learn is not None:
            changes["learn"] = flag(learn, "learn")
        restored = flag(restore, "restore")
        if not changes and not restored:
            raise Invalid(f"nothing to amend: give {', '.join(AMENDABLE)} or restore")
        return cls(trial_ids(list(ids)), changes, restored, text(reason, "reason"))

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Self:
        """Reads a request; raises `Invalid`."""
        ids = required(message, "ids")
        given = {name: message.get(name) for name in AMENDABLE}
        reason = message.get("reason", "")
        return cls.create(trial_ids(ids), **given, restore=message.get("restore", False), reason=reason)

    def to_wire(self) -> dict[str, Any]:
        """The request as a message map."""
        message = {"ids": list(self.ids), **self.changes, "reason": self.reason}
        return {**message, "restore": True} if self.restore else message


@final
@dataclass(frozen=True, slots=True)
class UndoRequest:
    """A request to undo the newest correction, or the newest trial that was reported by hand.

    Attributes:
        request: Id chosen by the client; the same request is executed once.
        worker: Trials of this worker instead of those that name none.
        reason: Kept in the log.
    """

    request: UUID
    worker: str | None = None
    reason: str = ""

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Self:
        """Reads a request; raises `Invalid`."""
        worker = message.get("worker")
        return cls(
            id_from_wire(required(message, "request"), "request"),
            None if worker is None else text(worker, "worker", longest=128),
            text(message.get("reason", ""), "reason"),
        )

    def to_wire(self) -> dict[str, Any]:
        """The request as a message map."""
        message: dict[str, Any] = {"request": self.request, "reason": self.reason}
        return message if self.worker is None else {**message, "worker": self.worker}
