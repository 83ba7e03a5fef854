"""What later events of a log say of its trials, so that a trial is handed out as it is today."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.protocol import array_from_wire, id_from_wire
from crkr.server.log.entries import Event

__all__ = ["Corrections", "values_of"]

_UNDOABLE: Final = frozenset({"recost", "remove", "amend"})


@final
class Corrections:
    """Follows the events of one task. Its one writer notes them; readers on other threads see whole events or none.

    Attributes:
        undone: Requests to undo that were carried out: their ids -> log positions of the events.
    """

    def __init__(self) -> None:
        self.undone: dict[UUID, int] = {}
        self._values: dict[bytes, dict[str, Any]] = {}  # of amended trials; a changed one is another map
        self._undoable: list[int] = []  # log positions, ascending

    @property
    def newest(self) -> int | None:
        """Log position of the newest correction that was not taken back and says what was before."""
        return self._undoable[-1] if self._undoable else None

    def note(self, event: Event) -> None:
        """Follow one event."""
        body = event.body
        if event.kind not in _UNDOABLE:
            return
        ids: Sequence[bytes] = body["ids"]
        if event.kind == "amend":
            self._values.update(zip(ids, body["values"], strict=True))
        elif event.kind == "recost":
            self._change((one, {"cost": cost}) for one, cost in zip(ids, body["costs"], strict=True))
        else:
            self._change((one, {"removed": True}) for one in ids)
        if "undoes" in body:
            self.undone[id_from_wire(body["request"])] = event.seq
            if body["undoes"] in self._undoable:  # not so for a trial
                self._undoable.remove(body["undoes"])
        elif "was" in body:
            self._undoable.append(event.seq)

    def _change(self, changes: Any) -> None:
        for one, change in changes:
            if one in self._values:
                self._values[one] = {**self._values[one], **change}

    def present(self, entry: dict[str, Any]) -> dict[str, Any]:
        """A trial as a log hands it out, a wire map, with today's values."""
        identity = entry["id"]
        values = self._values.get(identity)
        if values is None:
            return entry
        kept = {name: value for name, value in entry.items() if name not in ("learn", "outcome", "removed")}
        now = {name: values[name] for name in ("cost", "success", "kind")}
        if values["outcome"] is not None:
            now["outcome"] = np.array(values["outcome"], dtype=np.float64)
        if values["learn"] is not None:
            now["learn"] = values["learn"]
        if values["removed"]:
            now["removed"] = True
        return kept | now


def values_of(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a trial's wire map that an amend changes, as plain data."""
    outcome = entry.get("outcome")
    return {
        "cost": entry["cost"],
        "success": entry["success"],
        "learn": entry.get("learn"),
        "kind": entry["kind"],
        "outcome": None if outcome is None else array_from_wire(outcome, "outcome").tolist(),
        "removed": entry.get("removed", False),
    }
