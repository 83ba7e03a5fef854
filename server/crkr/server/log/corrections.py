"""Applies later events of a log to its trials: corrected values, removals and rollbacks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, final
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import array_from_wire, id_from_wire
from crkr.server.log.entries import Event

__all__ = ["CORRECTIONS", "Corrections", "Visible", "values_of"]

CORRECTIONS: Final = frozenset({"recost", "remove", "amend"})


@final
class Visible:
    """The log positions that count at a given one; a rollback hides those between its target and itself.

    Args:
        rollbacks: Log positions of the rollbacks, ascending, each with its target.
        upto: The last position that counts.
    """

    def __init__(self, rollbacks: Sequence[tuple[int, int]], upto: int) -> None:
        spans: list[tuple[int, int]] = []
        for seq, to in reversed(rollbacks):
            if seq <= upto:
                spans.append((seq, upto))
                upto = to
        self.spans: Final = [(1, upto), *reversed(spans)]  # first and last positions, ascending

    @classmethod
    def of(cls, rollbacks: Iterable[Event], upto: int) -> Visible:
        """Makes the value from a task's rollbacks, in order."""
        return cls([(event.seq, event.body["to"]) for event in rollbacks], upto)

    @property
    def whole(self) -> bool:
        """Whether nothing is hidden."""
        return len(self.spans) == 1

    def __contains__(self, seq: int) -> bool:
        return any(first <= seq <= last for first, last in self.spans)

    def mask(self, seqs: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of many positions count."""
        counted = np.zeros(len(seqs), dtype=np.bool_)
        for first, last in self.spans:
            counted |= (seqs >= first) & (seqs <= last)
        return counted


@final
class Corrections:
    """Follows the events of one task. One writer adds them; readers on other threads see whole events only.

    Attributes:
        undone: Ids of executed undo requests -> log positions of their events.
    """

    def __init__(self) -> None:
        self.undone: dict[UUID, int] = {}
        self._values: dict[bytes, dict[str, Any]] = {}  # of amended trials; a changed one is another map
        self._undoable: list[int] = []  # log positions, ascending
        self._rollbacks: list[tuple[int, int]] = []
        self._visible = Visible((), 2**62)

    @property
    def newest(self) -> int | None:
        """Log position of the newest correction that was not undone and holds the former values."""
        return self._undoable[-1] if self._undoable else None

    def note(self, event: Event) -> None:
        """Apply one event."""
        body = event.body
        if event.kind == "rollback":
            self._values.update(zip(body["ids"], body["values"], strict=True))
            self._undoable = [seq for seq in self._undoable if seq <= body["to"]]
            self._rollbacks.append((event.seq, body["to"]))
            self._visible = Visible(self._rollbacks, 2**62)
        if event.kind not in CORRECTIONS:
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

    def visible_at(self, seq: int) -> Visible:
        """What counted at a log position."""
        return Visible(self._rollbacks, seq)

    def values(self, entry: Mapping[str, Any]) -> dict[str, Any]:
        """Today's values of a trial as a log hands it out; whether a rollback hides it is not among them."""
        known = self._values.get(entry["id"])
        return values_of(entry) if known is None else known

    def present(self, entry: dict[str, Any]) -> dict[str, Any]:
        """A trial of the log, as a wire map with today's values."""
        hidden, values = self.hides(entry), self._values.get(entry["id"])
        if values is None:
            return {**entry, "removed": True} if hidden else entry
        kept = {name: value for name, value in entry.items() if name not in ("learn", "outcome", "removed")}
        now = {name: values[name] for name in ("cost", "success", "kind")}
        if values["outcome"] is not None:
            now["outcome"] = np.array(values["outcome"], dtype=np.float64)
        if values["learn"] is not None:
            now["learn"] = values["learn"]
        if values["removed"] or hidden:
            now["removed"] = True
        return kept | now

    def hides(self, entry: Mapping[str, Any]) -> bool:
        """Whether a rollback hides a trial."""
        return not self._visible.whole and entry["seq"] not in self._visible


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
