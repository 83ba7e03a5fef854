"""Entries of the log: trials and other events of a task, numbered together from 1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.protocol import Trial

__all__ = ["DELETED", "EVENT_KINDS", "Event", "LoggedTrial", "PendingReport", "Stored"]

EVENT_KINDS: Final = (
    "create", "recost", "remove", "amend", "configure", "fit", "restart", "rollback", "rename", "archive", "delete",
)  # fmt: skip
DELETED: Final = "deleted/"
"""Prefix of deleted tasks' names in a log; no key can contain it."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class LoggedTrial:
    """A trial as it was first reported.

    Attributes:
        seq: Log position in its task.
        time: When it was committed [unix s].
        trial: The trial with its original cost; a later `recost` is an event of its own.
    """

    seq: int
    time: float
    trial: Trial


@final
@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """An entry other than a trial.

    Attributes:
        seq: Log position in its task.
        time: When it was committed [unix s].
        kind: One of `EVENT_KINDS`.
        body: Plain data: the specification of a create; ids and costs of a recost; ids of a remove; ids and new values
            of an amend; changes of a configure; numbers of a fit; position and former values of a rollback; the new
            name of a rename or delete; empty for an archive or restart. `was` has former values, `undoes` the undone
            event, and `request` the id of a request that must not be executed twice.
    """

    seq: int
    time: float
    kind: str
    body: Mapping[str, Any]


@final
@dataclass(frozen=True, slots=True, eq=False)
class PendingReport:
    """Trials to store, all or none."""

    task: str
    trials: tuple[Trial, ...]


@final
@dataclass(frozen=True, slots=True, eq=False)
class Stored:
    """The result of a stored report.

    Attributes:
        seqs: Log positions in report order, the original one for a duplicate.
        fresh: The trials that were new, in log order.
    """

    seqs: tuple[int, ...]
    fresh: tuple[LoggedTrial, ...]
