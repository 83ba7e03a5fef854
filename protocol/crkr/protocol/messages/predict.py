"""The question "which goals in these states?" and its answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from crkr.protocol.checks import depth, entries, finite_array, flag, integer, required, text
from crkr.protocol.codec import MAX_STATES, Array, array_from_wire, frozen_from_wire, id_from_wire
from crkr.protocol.errors import Invalid

__all__ = ["PredictRequest", "Prediction", "check_states"]

# What a prediction has for each state.
_ROWS: Final = (
    "states",
    "goals",
    "means",
    "sigmas",
    "novelty",
    "success_probability",
    "predicted_outcome",
    "predicted_outcome_sd",
    "corrected",
)


def check_states(value: object, dimensions: int) -> Array:
    """States as (d,) or (b, d), checked; raises `Invalid`."""
    if type(value) is np.ndarray and value.ndim == 1:
        return finite_array(value, "states", (dimensions,))
    batch = depth(value, "states") == 2
    states = finite_array(value, "states", (None, dimensions) if batch else (dimensions,))
    if batch and not 1 <= len(states) <= MAX_STATES:
        raise Invalid(f"states must be 1 to {MAX_STATES} at once; got {len(states)}")
    return states


@final
@dataclass(frozen=True, slots=True, eq=False)
class PredictRequest:
    """One question for one or many states.

    Attributes:
        states: (d,) or (b, d).
        explore: Draw a goal to try, rather than the best known.
        trial_ids: One for each state, or empty: then the server makes them.
        worker: Name of the asking worker.
    """

    states: Array
    explore: bool = False
    trial_ids: tuple[UUID, ...] = ()
    worker: str | None = None

    @property
    def count(self) -> int:
        """Number of states."""
        return 1 if self.states.ndim == 1 else len(self.states)

    @classmethod
    def create(
        cls,
        dimensions: int,
        states: object,
        *,
        explore: object = False,
        trial_ids: object = None,
        worker: object = None,
    ) -> PredictRequest:
        """Checks a question against a task with states of `dimensions`; raises `Invalid`."""
        checked = check_states(states, dimensions)
        count = 1 if checked.ndim == 1 else len(checked)
        if trial_ids is None:
            trial_ids = ()
        if not isinstance(trial_ids, list | tuple):
            raise Invalid(f"trial_ids must be a list; got {type(trial_ids).__name__}")
        ids = tuple(id_from_wire(value, "trial_ids") for value in trial_ids)
        if ids and (len(ids) != count or len(set(ids)) != count):
            raise Invalid(f"trial_ids must be {count} different ids, one a state; got {len(ids)}")
        return cls(
            checked,
            flag(explore, "explore"),
            ids,
            None if worker is None else text(worker, "worker", longest=128),
        )

    @classmethod
    def from_wire(cls, message: Mapping[str, Any], dimensions: int) -> PredictRequest:
        """Reads a request; raises `Invalid`."""
        return cls.create(
            dimensions,
            array_from_wire(required(message, "states"), "states"),
            explore=message.get("explore", False),
            trial_ids=message.get("trial_ids"),
            worker=message.get("worker"),
        )

    def to_wire(self) -> dict[str, Any]:
        """The request as a message map."""
        message: dict[str, Any] = {"states": self.states}
        if self.explore:
            message["explore"] = True
        if self.trial_ids:
            message["trial_ids"] = list(self.trial_ids)
        if self.worker is not None:
            message["worker"] = self.worker
        return message


@final
@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The answer for one state, or with a leading b for a batch.

    Attributes:
        states: (d,) or (b, d) as asked.
        goals: (p,) or (b, p) to try, within the bounds.
        means: (p,) or (b, p) posterior means, not clipped.
        sigmas: (p,) or (b, p) exploration standard deviations, before truncation.
        novelty: () or (b,) in [0, 1]: 0 at a sample, 1 far from all.
        trial_ids: One a state, to report under.
        model_version: Log position that the model has applied.
        active: Samples in the model.
        policy: "mean", "corrected" or "explore".
        predicted_outcome: (q,) or (b, q) where it is modelled.
        predicted_outcome_sd: The same shape.
        compute_us: Time of the model itself [us], 0 where not measured.
        corrected: () or (b,) flags: goals moved from the mean because of the expected outcome. Not sent: over the
            network `policy` says it for all. None where outcomes are not modelled.
        success_probability: () or (b,) probability that the goals succeed, NaN if unknown; None from a server of
            version 0.1.
    """

    states: Array
    goals: Array
    means: Array
    sigmas: Array
    novelty: Array
    trial_ids: list[UUID]
    model_version: int
    active: int
    policy: str
    predicted_outcome: Array | None = None
    predicted_outcome_sd: Array | None = None
    compute_us: int = 0
    corrected: NDArray[np.bool_] | None = None
    success_probability: Array | None = None

    @property
    def goal(self) -> Array:
        """`goals`, for one state."""
        return self.goals

    @property
    def mean(self) -> Array:
        """`means`, for one state."""
        return self.means

    @property
    def sigma(self) -> Array:
        """`sigmas`, for one state."""
        return self.sigmas

    @property
    def state(self) -> Array:
        """`states`, for one state."""
        return self.states

    @property
    def trial_id(self) -> UUID:
        """The only id; raises `Invalid` for a batch."""
        if len(self.trial_ids) != 1:
            raise Invalid(f"a batch of {len(self.trial_ids)} has no single trial_id; use trial_ids")
        return self.trial_ids[0]

    def expectation(self, row: int | None = None) -> dict[str, Any]:
        """The expectation for a goal, as `info` of its trial: {"predicted": ...}; {} if unknown.

        Displays compare it with the trial's result.

        Args:
            row: Which goal of a batch.
        """
        names = {
            "success": self.success_probability,
            "outcome": self.predicted_outcome,
            "sd": self.predicted_outcome_sd,
        }
        chosen = {name: value if row is None or value is None else value[row] for name, value in names.items()}
        known = {
            name: value.tolist() for name, value in chosen.items() if value is not None and not np.isnan(value).all()
        }
        return {"predicted": known} if known else {}

    @classmethod
    def joined(cls, parts: Sequence[Prediction]) -> Prediction:
        """One answer for the states of several batches, in order.

        If their models differ, version and count are those of the oldest.
        """

        def rows(name: str) -> NDArray[Any] | None:
            arrays = [getattr(part, name) for part in parts]
            if any(array is None for array in arrays):
                return None
            every: NDArray[Any] = np.concatenate(arrays)
            every.setflags(write=False)
            return every

        joined: dict[str, Any] = {name: rows(name) for name in _ROWS}
        oldest = min(parts, key=lambda part: part.model_version)
        return replace(
            oldest,
            trial_ids=[one for part in parts for one in part.trial_ids],
            policy="corrected" if any(part.policy == "corrected" for part in parts) else oldest.policy,
            compute_us=sum(part.compute_us for part in parts),
            **joined,
        )

    def to_wire(self) -> dict[str, Any]:
        """The answer as a message map."""
        message: dict[str, Any] = {
            name: getattr(self, name)
            for name in (
                "goals",
                "means",
                "sigmas",
                "novelty",
                "success_probability",
                "trial_ids",
                "model_version",
                "active",
                "policy",
                "compute_us",
            )
            if getattr(self, name) is not None
        }
        if self.predicted_outcome is not None:
            message["predicted_outcome"] = self.predicted_outcome
            message["predicted_outcome_sd"] = self.predicted_outcome_sd
        return message

    @classmethod
    def from_wire(cls, message: Mapping[str, Any], states: Array) -> Prediction:
        """Reads an answer to `states`; raises `Invalid`."""

        def array(name: str) -> Array:
            return frozen_from_wire(required(message, name), name)

        modelled = "predicted_outcome" in message
        return cls(
            states=states,
            goals=array("goals"),
            means=array("means"),
            sigmas=array("sigmas"),
            novelty=array("novelty"),
            trial_ids=[id_from_wire(value, "trial_ids") for value in entries(message, "trial_ids")],
            model_version=integer(required(message, "model_version"), "model_version"),
            active=integer(required(message, "active"), "active"),
            policy=text(required(message, "policy"), "policy", longest=32),
            predicted_outcome=array("predicted_outcome") if modelled else None,
            predicted_outcome_sd=array("predicted_outcome_sd") if modelled else None,
            compute_us=integer(message.get("compute_us", 0), "compute_us"),
            success_probability=array("success_probability") if "success_probability" in message else None,
        )
