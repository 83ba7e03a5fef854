"""Reported trials, the receipt, and stored trials as the log returns them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

from crkr.protocol.checks import entries, flag, integer, number, required
from crkr.protocol.codec import MAX_TRIALS
from crkr.protocol.errors import Invalid
from crkr.protocol.info import restored_info
from crkr.protocol.specification.task_spec import TaskSpec
from crkr.protocol.trial import Trial

__all__ = ["Receipt", "ReportRequest", "StoredTrial"]


@final
@dataclass(frozen=True, slots=True, eq=False)
class ReportRequest:
    """Trials to store, all or none.

    Attributes:
        trials: 1 to 1024 trials.
        wait: Answer only after the model includes them.
    """

    trials: tuple[Trial, ...]
    wait: bool = False

    @classmethod
    def from_wire(cls, message: Mapping[str, Any], spec: TaskSpec) -> ReportRequest:
        """Reads a request; raises `Invalid`, which says which trial is wrong."""
        entries = required(message, "trials")
        if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_TRIALS:
            got = f"{len(entries)}" if isinstance(entries, list) else type(entries).__name__
            raise Invalid(f"trials must be a list of 1 to {MAX_TRIALS}; got {got}")
        trials = []
        for index, entry in enumerate(entries):
            try:
                trials.append(Trial.from_wire(entry, spec))
            except Invalid as error:
                details = {**error.details, "trial": index}
                raise Invalid(f"trials[{index}]: {error.message}", details=details) from error
        return cls(tuple(trials), flag(message.get("wait", False), "wait"))

    def to_wire(self) -> dict[str, Any]:
        """The request as a message map."""
        message: dict[str, Any] = {"trials": [trial.to_wire() for trial in self.trials]}
        if self.wait:
            message["wait"] = True
        return message


@final
@dataclass(frozen=True, slots=True)
class Receipt:
    """The receipt of a report: its trials are stored.

    Attributes:
        accepted: New trials.
        duplicates: Trials that were already stored with the same content.
        seqs: Log positions in the order of the request.
        model_version: Log position that the model had applied when this was written.
    """

    accepted: int
    duplicates: int
    seqs: tuple[int, ...]
    model_version: int

    def to_wire(self) -> dict[str, Any]:
        """The receipt as a message map."""
        return {
            "accepted": self.accepted,
            "duplicates": self.duplicates,
            "seqs": list(self.seqs),
            "model_version": self.model_version,
        }

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Receipt:
        """Reads a receipt; raises `Invalid`."""
        return cls(
            integer(required(message, "accepted"), "accepted"),
            integer(required(message, "duplicates"), "duplicates"),
            tuple(integer(seq, "seqs") for seq in entries(message, "seqs")),
            integer(required(message, "model_version"), "model_version"),
        )


@final
@dataclass(frozen=True, slots=True, eq=False)
class StoredTrial:
    """A trial as the log holds it.

    Attributes:
        trial: The trial, with its current cost.
        seq: Its log position.
        time: When it was committed [unix s].
        removed: Excluded from learning by `remove`.
    """

    trial: Trial
    seq: int
    time: float
    removed: bool = False

    def to_wire(self) -> dict[str, Any]:
        """The trial's fields, seq, time, and removed where true."""
        message = {**self.trial.to_wire(), "seq": self.seq, "time": self.time}
        if self.removed:
            message["removed"] = True
        return message

    @classmethod
    def from_wire(cls, message: Mapping[str, Any], spec: TaskSpec) -> StoredTrial:
        """Reads one entry of a `samples` page; raises `Invalid`."""
        return cls(
            Trial.from_wire(message, spec, _stored_info),
            integer(required(message, "seq"), "seq"),
            number(required(message, "time"), "time"),
            flag(message.get("removed", False), "removed"),
        )


def _stored_info(value: object) -> dict[str, Any]:
    return {} if value is None else restored_info(value)
