"""From log entries to the learner: the one way in, for what was just committed and for what is replayed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from crkr.learner import Learner
from crkr.protocol import Internal
from crkr.server.log import Event, LoggedTrial

__all__ = ["apply_entries", "batches"]


def batches(entries: Iterable[LoggedTrial | Event], most: int) -> Iterable[list[LoggedTrial] | Event]:
    """The same entries in the same order, neighbouring trials together, at most so many."""
    trials: list[LoggedTrial] = []
    for entry in entries:
        if isinstance(entry, Event) or len(trials) == most:
            if trials:
                yield trials
            trials = []
        if isinstance(entry, Event):
            yield entry
        else:
            trials.append(entry)
    if trials:
        yield trials


def apply_entries(learner: Learner, entries: Sequence[LoggedTrial] | Event) -> Any:
    """Applies trials, or one event, under the positions that the log gave them; returns what the learner returned."""
    if not isinstance(entries, Event):
        return learner.apply_trials([entry.seq for entry in entries], [entry.trial for entry in entries])
    body, seq = entries.body, entries.seq
    match entries.kind:
        case "recost":
            return learner.apply_recost(seq, body["ids"], body["costs"])
        case "remove":
            return learner.apply_remove(seq, body["ids"])
        case "configure":
            return learner.apply_configure(seq, body["changes"])
        case "fit":
            return learner.apply_fit(seq, body["lengthscales"], body["signal_variance"])
        case "restart":
            return learner.apply_restart(seq)
        case "archive":
            return learner.apply_configure(seq, {})  # changes nothing but the position
        case "create":  # the learner was made from it
            return None
    raise Internal(f"log position {seq} holds an event of kind {entries.kind!r}, which this version does not know")
