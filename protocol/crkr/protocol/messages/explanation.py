"""Why the model answers as it does: the samples behind it, and what suppressed a sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final
from uuid import UUID

from crkr.protocol.checks import entries, flag, number, required
from crkr.protocol.codec import id_from_wire

__all__ = ["Explanation", "Neighbour", "SampleExplanation"]


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
    """Where one sample stands.

    Attributes:
        id: The sample.
        active: It is in the model.
        eligible: It may be learned from.
        suppressor: The better sample nearest to it; None where there is none or the selector knows none.
        radius: Distance to the suppressor in creation length-scales; None where it is infinite or unknown.
    """

    id: UUID
    active: bool
    eligible: bool
    suppressor: UUID | None
    radius: float | None


@final
@dataclass(frozen=True, slots=True)
class Explanation:
    """The answer of `explain`.

    Attributes:
        neighbours: Most influential active samples, largest |weight| first.
        novelty: In [0, 1].
        sample: Where the sample asked about stands, if one was.
    """

    neighbours: tuple[Neighbour, ...]
    novelty: float
    sample: SampleExplanation | None = None

    def to_wire(self) -> dict[str, Any]:
        """The answer as a message map; the sample's fields stand beside the others."""
        message: dict[str, Any] = {
            "neighbours": [
                {"id": n.id, "weight": n.weight, "cost": n.cost, "distance": n.distance} for n in self.neighbours
            ],
            "novelty": self.novelty,
        }
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
        return cls(neighbours, number(required(message, "novelty"), "novelty"), sample)
