"""Why the model gives an answer: the samples behind it, and what suppressed a sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, final
from uuid import UUID

from crkr.protocol.checks import entries, flag, integer, number, required, text
from crkr.protocol.codec import id_from_wire

__all__ = ["Explanation", "Grounds", "Neighbour", "SampleExplanation"]


@final
@dataclass(frozen=True, slots=True)
class Neighbour:
    """An active sample and its part in an answer.

    Attributes:
        id: The sample.
        weight: Its weight in the mean, k(s)^T (K + lambda C)^-1.
        cost: Its cost.
        distance: Distance of its state in length-scales.
    """

    id: UUID
    weight: float
    cost: float
    distance: float


@final
@dataclass(frozen=True, slots=True)
class SampleExplanation:
    """Status of one sample.

    Attributes:
        id: The sample.
        active: It is in the model.
        eligible: It may be learned from.
        suppressor: The better sample nearest to it; None without one.
        radius: Distance to the suppressor in creation length-scales; None where it is infinite or unknown.
    """

    id: UUID
    active: bool
    eligible: bool
    suppressor: UUID | None
    radius: float | None


@final
@dataclass(frozen=True, slots=True)
class Grounds:
    """What the goal for a state is based on.

    Attributes:
        policy: "mean" of the samples, or "corrected" by what earlier trials led to.
        samples: Active samples behind the mean.
        success_probability: Probability that the goal succeeds; None if unknown.
        tried: Number of trials considered, those in the states nearest to this one.
        succeeded: How many of these succeeded.
    """

    policy: str
    samples: int
    success_probability: float | None
    tried: int
    succeeded: int

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Grounds:
        """Reads the fields; raises `Invalid`."""
        chance = message.get("success_probability")
        return cls(
            text(required(message, "policy"), "policy"),
            integer(required(message, "samples"), "samples"),
            None if chance is None else number(chance, "success_probability"),
            integer(required(message, "tried"), "tried"),
            integer(required(message, "succeeded"), "succeeded"),
        )


@final
@dataclass(frozen=True, slots=True)
class Explanation:
    """The answer of `explain`.

    Attributes:
        neighbours: Most influential active samples, largest |weight| first.
        novelty: In [0, 1].
        sample: Status of the sample asked about, if any.
        grounds: What the goal is based on; None from a server of version 0.1, and for a state that the task refuses.
    """

    neighbours: tuple[Neighbour, ...]
    novelty: float
    sample: SampleExplanation | None = None
    grounds: Grounds | None = None

    @property
    def summary(self) -> str:
        """What the goal is based on, in one sentence; "" if unknown."""
        own = self.grounds
        if own is None:
            return ""
        near = f", the nearest {min(n.distance for n in self.neighbours):.2g} length-scales away" if own.samples else ""
        basis = f"the mean of {own.samples} {'sample' if own.samples == 1 else 'samples'}{near}"
        if not own.samples:
            basis = "the outcomes of earlier trials alone"
        elif own.policy == "corrected":
            basis += ", corrected by the outcomes of earlier trials"
        seen = f"; {own.succeeded} of the {own.tried} trials nearest to this state succeeded" if own.tried else ""
        chance = own.success_probability
        hope = "" if chance is None else f", and this goal should with probability {chance:.2f}"
        return f"The goal is {basis}{seen}{hope}."

    def to_wire(self) -> dict[str, Any]:
        """The answer as a message map; the sample's fields are beside the others."""
        message: dict[str, Any] = {
            "neighbours": [
                {"id": n.id, "weight": n.weight, "cost": n.cost, "distance": n.distance} for n in self.neighbours
            ],
            "novelty": self.novelty,
        }
        if self.grounds is not None:
            message["grounds"] = asdict(self.grounds)
        if self.sample is not None:
            message |= {
                "sample_id": self.sample.id,
                "active": self.sample.active,
                "eligible": self.sample.eligible,
                "suppressor": self.sample.suppressor,
                "radius": self.sample.radius,
            }
        return message

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Explanation:
        """Reads an answer; raises `Invalid`."""
        neighbours = tuple(
            Neighbour(
                id_from_wire(required(entry, "id")),
                number(required(entry, "weight"), "weight"),
                number(required(entry, "cost"), "cost"),
                number(required(entry, "distance"), "distance"),
            )
            for entry in entries(message, "neighbours")
        )
        sample = None
        if "sample_id" in message:
            suppressor, radius = message.get("suppressor"), message.get("radius")
            sample = SampleExplanation(
                id_from_wire(message["sample_id"], "sample_id"),
                flag(required(message, "active"), "active"),
                flag(message.get("eligible", True), "eligible"),
                None if suppressor is None else id_from_wire(suppressor, "suppressor"),
                None if radius is None else number(radius, "radius"),
            )
        grounds = message.get("grounds")
        return cls(
            neighbours,
            number(required(message, "novelty"), "novelty"),
            sample,
            None if grounds is None else Grounds.from_wire(grounds),
        )
