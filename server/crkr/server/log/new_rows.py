"""Makes new table rows from reports and events, before anything is stored."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, final

from crkr.protocol import Conflict, Trial, id_from_wire, pack, unpack
from crkr.server.log.entries import Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.rows import DIGEST_BYTES, body_digest, changed_digest, trial_row

__all__ = ["NewRows", "changed_marks", "event_row", "new_name"]

Find = Callable[[int, bytes], tuple[int, bytes] | None]


@final
class NewRows:
    """Rows of the trials of several reports, to be stored together.

    Args:
        last: Task -> log position of its last entry; advances with additions.

    Attributes:
        trials: The rows: the task's key, then `TRIAL_COLUMNS`.
    """

    def __init__(self, last: dict[str, int]) -> None:
        self.trials: Final[list[tuple[Any, ...]]] = []
        self._last, self._now = last, time.time()
        self._seen: dict[tuple[int, bytes], tuple[int, bytes]] = {}

    def add(self, key: int, report: PendingReport, find: Find) -> Stored | Conflict:
        """Add the new trials of a report; a conflicting report adds nothing.

        Args:
            key: The task's key.
            report: The report.
            find: Returns position and digest of a stored trial by key and id, or None.
        """
        last = self._last[report.task]
        seqs: list[int] = []
        fresh: list[LoggedTrial] = []
        rows: list[tuple[Any, ...]] = []
        seen: dict[tuple[int, bytes], tuple[int, bytes]] = {}
        for trial in report.trials:
            digest, name = trial.digest(), (key, trial.id.bytes)
            known = seen.get(name) or self._seen.get(name) or find(*name)
            if known is None:
                known = (last + len(fresh) + 1, digest)
                fresh.append(LoggedTrial(known[0], self._now, trial))
                rows.append(trial_row(key, known[0], self._now, trial, digest))
            elif known[1][:DIGEST_BYTES] != digest:
                return _conflict(trial, int(known[0]))
            seen[name] = known
            seqs.append(int(known[0]))
        self._seen |= seen
        self.trials.extend(rows)
        self._last[report.task] = last + len(fresh)
        return Stored(tuple(seqs), tuple(fresh))


def event_row(key: int, seq: int, kind: str, body: Mapping[str, Any]) -> tuple[Event, tuple[Any, ...]]:
    """An event as a reader returns it, and its row: task, seq, time, kind, body, digest."""
    now, data = time.time(), pack(body)
    return Event(seq, now, kind, unpack(data, depth=None)), (key, seq, now, kind, data, body_digest(kind, data))


def changed_marks(event: Event, find: Callable[[bytes], tuple[Any, ...] | None], key: int) -> Iterator[tuple[Any, ...]]:
    """The trial rows that an event changes: current cost, removed, digest, task and id of each.

    Args:
        event: The event; only recost and remove change rows.
        find: Returns the row of a trial, `ROW_COLUMNS`, by its id.
        key: The task's key.
    """
    costs = event.body["costs"] if event.kind == "recost" else None
    if costs is None and event.kind != "remove":
        return
    for place, one in enumerate(event.body["ids"]):
        row = find(id_from_wire(one).bytes)
        if row is not None:
            cost = row[13] if costs is None else costs[place] + 0.0  # SQLite drops -0.0's sign
            removed = bool(row[14]) or costs is None
            yield cost, int(removed), changed_digest(row, cost, removed), key, row[2]


def new_name(event: Event) -> str | None:
    """The new name that an event gives its task; None for most."""
    return str(event.body["name"]) if event.kind in ("rename", "delete") else None


def _conflict(trial: Trial, seq: int) -> Conflict:
    return Conflict(
        f"trial {trial.id} is stored at log position {seq} with other content; use a new id for a new trial",
        details={"id": trial.id.bytes, "seq": seq},
    )
