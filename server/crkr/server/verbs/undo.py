"""The verb undo: an event that takes back the newest correction or trial of a task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final
from uuid import UUID

from crkr.protocol import Internal, Invalid, UndoRequest, id_from_wire
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import LogReader, values_of
from crkr.server.verbs.admin import Answer, Change, amendment, removal

__all__ = ["read_undo"]

_LOOKED_BACK: Final = 1000  # newest trials to search; a person undoes recent ones
_PAGE_BYTES: Final = 2**24


def read_undo(message: Mapping[str, Any], task: ServedTask, log: LogReader) -> Change:
    """The change that takes back the newest correction, or the newest trial reported by hand, whichever came later.

    A repeated request changes nothing and gets the same answer. A further undo goes one step further back; an undo
    itself cannot be undone.

    Raises:
        Invalid: There is nothing to undo.
    """
    asked = UndoRequest.from_wire(message)
    before = task.corrections.undone.get(asked.request)
    if before is not None:
        return _repeated(before, task, log)
    correction, trial = task.corrections.newest, _newest_trial(task, log, asked.worker)
    if trial is not None and (correction is None or trial["seq"] > correction):
        body = {"reason": asked.reason, "request": asked.request, "undoes": trial["seq"]}
        identity = id_from_wire(trial["id"])
        return removal([identity], body, _answer("trial", trial["seq"], [identity]))
    if correction is None:
        whose = "reported by hand" if asked.worker is None else f"of worker {asked.worker!r}"
        raise Invalid(f"there is nothing to undo: no correction, and no trial {whose} among the newest {_LOOKED_BACK}")
    event = log.event(task.name, correction)
    if event is None:
        raise Internal(f"the log of task {task.name!r} has no event at position {correction}")
    ids, was = [id_from_wire(one) for one in event.body["ids"]], event.body["was"]
    body = {"reason": asked.reason, "request": asked.request, "undoes": correction}

    def now(present: Mapping[str, Any], place: int) -> Mapping[str, Any]:
        if event.kind == "amend":
            return dict(was[place])
        name = "cost" if event.kind == "recost" else "removed"
        return {**values_of(present), name: was[place]}

    return amendment(ids, now, body, _answer(event.kind, correction, ids))


def _newest_trial(task: ServedTask, log: LogReader, worker: str | None) -> dict[str, Any] | None:
    found, _ = log.page_before(task.name, None, _LOOKED_BACK, _PAGE_BYTES)
    mine = (task.corrections.present(trial) for trial in found if trial.get("worker") == worker)
    return next((trial for trial in mine if not trial.get("removed")), None)


def _repeated(seq: int, task: ServedTask, log: LogReader) -> Change:
    """No change, and the answer to the earlier request."""
    event = log.event(task.name, seq)
    if event is None:
        raise Internal(f"the log of task {task.name!r} has no event at position {seq}")
    ids, undone = [id_from_wire(one) for one in event.body["ids"]], event.body["undoes"]
    taken_back = log.event(task.name, undone)
    answer = _answer("trial" if taken_back is None else taken_back.kind, undone, ids)
    return Change("amend", {}, answer, ids, lambda _present: None)


def _answer(what: str, seq: int, ids: list[UUID]) -> Answer:
    found = {"undone": what, "undone_seq": seq, "ids": ids}
    return lambda _task, _result: found
