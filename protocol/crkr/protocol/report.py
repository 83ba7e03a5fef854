"""The statement "these goals cost that", its receipt, and stored trials as the log returns them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final
from uuid import UUID, uuid4

import numpy as np
from crkr.protocol.checks import flag, integer, number, required
from crkr.protocol.codec import MAX_TRIALS, id_from_wire
from crkr.protocol.errors import Invalid
from crkr.protocol.predict import Prediction
from crkr.protocol.task_spec import TaskSpec
from crkr.protocol.trial import Trial

__all__ = ["Receipt", "ReportRequest", "StoredTrial", "make_trials"]


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
        """Reads a request; raises `Invalid` that says which trial is wrong."""
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
    """What became of a report; when you hold it, the trials are stored.

    Attributes:
        accepted: New trials.
        duplicates: Trials that were stored before with the same content.
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
            tuple(integer(seq, "seqs") for seq in required(message, "seqs")),
            integer(required(message, "model_version"), "model_version"),
        )


@final
@dataclass(frozen=True, slots=True, eq=False)
class StoredTrial:
    """A trial as the log holds it.

    Attributes:
        trial: The trial, with its present cost.
        seq: Its log position.
        time: When it was committed [unix s].
        removed: Taken out of learning by `remove`.
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
            Trial.from_wire(message, spec),
            integer(required(message, "seq"), "seq"),
            number(required(message, "time"), "time"),
            flag(message.get("removed", False), "removed"),
        )


def make_trials(
    spec: TaskSpec,
    answer: Prediction | None = None,
    *,
    state: object = None,
    goal: object = None,
    cost: object,
    success: object,
    kind: str = "trial",
    id: UUID | bytes | Sequence[UUID | bytes] | None = None,  # noqa: A002 - the protocol's word
    outcome: object = None,
    worker: str | None = None,
    model_version: int | None = None,
    info: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
) -> tuple[Trial, ...]:
    """The trials that the arguments of `report` mean, for one or for a batch.

    Args:
        spec: The task.
        answer: The prediction that was tried: gives state, goal, ids and model_version.
        state: (d,) or (b, d) where there is no answer.
        goal: (p,) or (b, p) that was executed; overrides the answer's goals.
        cost: One cost in [0, 1] or None, or b of them.
        success: One flag, or b of them.
        kind: The kind of all of them.
        id: One id, or b of them; the answer's, or random ones, where absent.
        outcome: (q,) or (b, q), or None.
        worker: Who reports.
        model_version: The model that proposed the goals.
        info: One map for all, or b of them.

    Raises:
        Invalid: Neither answer nor state and goal, sizes that disagree, or a value that is not allowed.
    """
    if answer is not None:
        state = answer.states if state is None else state
        goal = answer.goals if goal is None else goal
        id = answer.trial_ids if id is None else id  # noqa: A001
        model_version = answer.model_version if model_version is None else model_version
    if state is None or goal is None:
        raise Invalid("report needs an answer of predict, or both state and goal")
    single = np.ndim(state) < 2  # type: ignore[arg-type]
    count = 1 if single else len(state)  # type: ignore[arg-type]
    ids = [uuid4() for _ in range(count)] if id is None else [id] if isinstance(id, UUID | bytes) else list(id)

    def rows(value: object, name: str) -> list[Any]:
        """One value a trial."""
        if single:
            return [value]
        if len(value) != count:  # type: ignore[arg-type]
            raise Invalid(f"{name} must have one entry a state: {count}; got {len(value)}")  # type: ignore[arg-type]
        return list(value)  # type: ignore[call-overload]

    def spread(value: object) -> list[Any]:
        """One value a trial, from one for all or one each."""
        is_list = isinstance(value, list | tuple | np.ndarray) and np.ndim(value) > 0  # type: ignore[arg-type]
        return list(value) if is_list else [value] * count  # type: ignore[call-overload]

    outcomes = [None] * count if outcome is None else rows(outcome, "outcome")
    columns = {"cost": spread(cost), "success": spread(success), "id": ids, "info": spread(info)}
    for name, column in columns.items():
        if len(column) != count:
            raise Invalid(f"{name} must have one entry a state: {count}; got {len(column)}")
    return tuple(
        Trial.create(
            spec,
            id=id_from_wire(columns["id"][index]),
            state=one_state,
            goal=one_goal,
            cost=columns["cost"][index],
            success=columns["success"][index],
            kind=kind,
            outcome=one_outcome,
            worker=worker,
            model_version=model_version,
            info=columns["info"][index],
        )
        for index, (one_state, one_goal, one_outcome) in enumerate(
            zip(rows(state, "state"), rows(goal, "goal"), outcomes, strict=True)
        )
    )
