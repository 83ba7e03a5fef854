"""Corrections and other administration of a task, as methods of `Task`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any
from uuid import UUID, uuid4

from crkr.protocol import AmendRequest, UndoRequest, check_name
from crkr.protocol.checks import finite_array

__all__ = ["Administration"]


class Administration(ABC):
    """What an administrator of a task may ask; every method may raise `Unavailable` and `UnknownTask`."""

    @abstractmethod
    def _admin(self, verb: str, message: Mapping[str, Any], timeout_s: float | None) -> dict[str, Any]:
        """Sends a message to the task's verb and returns the answer."""

    def recost(
        self, ids: Sequence[UUID], costs: object, reason: str = "", *, timeout_s: float | None = None
    ) -> dict[str, Any]:
        """Replaces the costs of stored trials: `changed`, `seq`, `model_version`."""
        checked = finite_array(costs, "costs", (len(ids),))
        return self._admin("recost", {"ids": list(ids), "costs": checked, "reason": reason}, timeout_s)

    def amend(
        self,
        ids: UUID | Sequence[UUID],
        *,
        success: bool | None = None,
        cost: float | None = None,
        outcome: object = None,
        kind: str | None = None,
        learn: bool | None = None,
        restore: bool = False,
        reason: str = "",
        timeout_s: float | None = None,
    ) -> dict[str, Any]:
        """Corrects stored trials and what was learned from them; the log keeps the reports.

        A correction that is repeated changes nothing.

        Args:
            ids: The trials.
            success: Whether they succeeded.
            cost: In [0, 1]; a new label brings its own where the task learns from labels.
            outcome: (q,) measured, NaN where not observed.
            kind: "trial", "demonstration", "evaluation" or "failed".
            learn: Whether the regression may learn from it, only for kind "trial".
            restore: Learn from removed trials again.
            reason: Kept in the log.
            timeout_s: Deadline [s].

        Returns:
            `changed`, `seq`, `model_version`.

        Raises:
            Invalid: An unknown id, a removed trial without `restore`, or values that do not fit; nothing changed.
        """
        values = {"success": success, "cost": cost, "outcome": outcome, "kind": kind, "learn": learn}
        asked = AmendRequest.create([ids] if isinstance(ids, UUID) else ids, **values, restore=restore, reason=reason)
        return self._admin("amend", asked.to_wire(), timeout_s)

    def undo(self, *, worker: str | None = None, reason: str = "", timeout_s: float | None = None) -> dict[str, Any]:
        """Takes back the newest correction, or the newest trial that was reported by hand, whichever came later.

        Corrections are `amend`, `recost` and `remove`. Calling it again goes one step further back.

        Args:
            worker: Trials of this worker, instead of those that name none.
            reason: Kept in the log.
            timeout_s: Deadline [s].

        Returns:
            `undone` ("trial", "amend", "recost" or "remove"), `undone_seq`, `ids`, `seq`, `model_version`.

        Raises:
            Invalid: There is nothing to undo.
        """
        return self._admin("undo", UndoRequest(uuid4(), worker, reason).to_wire(), timeout_s)

    def rollback(self, to: int, reason: str = "", *, timeout_s: float | None = None) -> dict[str, Any]:
        """Makes the policy the one of an earlier version again: what came later no longer counts.

        Later trials, corrections and settings stay in the log; a rollback to a later version brings them back.

        Args:
            to: The `model_version` to go back to.
            reason: Kept in the log.
            timeout_s: Deadline [s].

        Returns:
            `to`, `seq`, `model_version`.

        Raises:
            Invalid: There is no such version.
        """
        return self._admin("rollback", {"to": to, "reason": reason}, timeout_s)

    def rename(self, name: str, *, timeout_s: float | None = None) -> dict[str, Any]:
        """Gives the task another name, under which `Client.task` finds it from then on.

        Raises:
            Invalid: The name cannot be a task's.
            Conflict: There is a task of that name, or workers train this one.
        """
        return self._admin("rename", {"name": check_name(name), "request": uuid4()}, timeout_s)

    def delete(self, *, timeout_s: float | None = None) -> dict[str, Any]:
        """Takes the task out of service and frees its name; `crkr purge` removes its data for good.

        Raises:
            Conflict: Workers train it.
        """
        return self._admin("delete", {"request": uuid4()}, timeout_s)

    def remove(self, ids: Sequence[UUID], reason: str = "", *, timeout_s: float | None = None) -> dict[str, Any]:
        """Removes trials from the model; the log keeps them, marked: `removed`, `seq`, `model_version`."""
        return self._admin("remove", {"ids": list(ids), "reason": reason}, timeout_s)

    def refit(self, *, timeout_s: float | None = None) -> dict[str, Any]:
        """Fits the kernel by its evidence: returns the hyper-parameters, or `accepted` False."""
        return self._admin("refit", {}, timeout_s)

    def archive(self, *, timeout_s: float | None = None) -> dict[str, Any]:
        """Ends learning for good; the task still answers and keeps its data."""
        return self._admin("archive", {}, timeout_s)
