"""The settings of a model: everything but its samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from crkr.learner.cost import noise_variances
from crkr.learner.kernel import Kernel
from crkr.protocol import Array, Invalid, TaskSpec
from crkr.protocol.codec import array_from_wire
from crkr.protocol.specification.settings import Start

__all__ = ["Parameters"]


@final
@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """Settings of a model, taken from a task's specification and its fitted hyper-parameters.

    Attributes:
        task: Name of the task.
        seed: Seed of its exploration draws.
        kernel: Covariance of the scaled goals.
        prior: (p,) goal far from all samples [units of the goal].
        scales: (p,) scales of the goals [units of the goal].
        low: (p,) lowest goals allowed [units of the goal].
        high: (p,) highest goals allowed [units of the goal].
        regularisation: lambda.
        cost_map: "linear" or "odds".
        noise_floor: Smallest noise, relative to the signal variance.
        explore_scale: Multiplies sigma.
        exploration_floor: Added to sigma^2 in scaled units.
        novelty_limit: Novelty above which states are refused; None: no limit.
        start: Exploration before the first success.
    """

    task: str
    seed: int
    kernel: Kernel
    prior: Array
    scales: Array
    low: Array
    high: Array
    regularisation: float
    cost_map: str
    noise_floor: float
    explore_scale: float
    exploration_floor: float
    novelty_limit: float | None
    start: Start = field(default_factory=Start)

    @classmethod
    def create(cls, spec: TaskSpec, kernel: Kernel, prior: Array) -> Parameters:
        """The settings of `spec`, with the kernel and the prior mean in force."""
        low, high = spec.bounds
        return cls(
            task=spec.name,
            seed=spec.seed,
            kernel=kernel,
            prior=_read_only(prior),
            scales=_read_only(spec.scales),
            low=_read_only(low),
            high=_read_only(high),
            regularisation=spec.regularisation,
            cost_map=spec.cost_map,
            noise_floor=spec.noise_floor,
            explore_scale=spec.explore_scale,
            exploration_floor=spec.exploration_floor,
            novelty_limit=spec.novelty_limit if spec.novel == "refuse" else None,
            start=spec.start,
        )

    def noise(self, costs: Array) -> Array:
        """Noise variances (n,) of samples with costs (n,), in squared scaled goals."""
        floor = self.noise_floor * self.kernel.signal_variance
        return noise_variances(costs, self.regularisation, self.cost_map, floor)

    def to_wire(self) -> dict[str, Any]:
        """The settings as the `model` query returns them."""
        return {
            "kernel": {
                "type": "se-ard",
                "centre": self.kernel.centre,
                "lengthscales": self.kernel.lengthscales,
                "signal_variance": self.kernel.signal_variance,
                "linear_weight": self.kernel.linear_weight,
            },
            "scales": self.scales,
            "prior": self.prior,
            "noise": {"regularisation": self.regularisation, "cost_map": self.cost_map, "floor": self.noise_floor},
            "bounds": {"low": self.low, "high": self.high},
            "exploration": {"scale": self.explore_scale, "floor": self.exploration_floor, "seed": self.seed},
            "novelty_limit": self.novelty_limit,
            "task": self.task,
        }

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Parameters:
        """Reads the result of `to_wire`.

        Raises:
            Invalid: A field is missing or has another form.
        """
        try:
            kernel, noise, exploration = message["kernel"], message["noise"], message["exploration"]
            limit = message.get("novelty_limit")
            return cls(
                task=str(message["task"]),
                seed=int(exploration["seed"]),
                kernel=Kernel(
                    _array(kernel["centre"]),
                    _array(kernel["lengthscales"]),
                    float(kernel["signal_variance"]),
                    float(kernel["linear_weight"]),
                ),
                prior=_array(message["prior"]),
                scales=_array(message["scales"]),
                low=_array(message["bounds"]["low"]),
                high=_array(message["bounds"]["high"]),
                regularisation=float(noise["regularisation"]),
                cost_map=str(noise["cost_map"]),
                noise_floor=float(noise["floor"]),
                explore_scale=float(exploration["scale"]),
                exploration_floor=float(exploration["floor"]),
                novelty_limit=None if limit is None else float(limit),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise Invalid(f"a model's settings must be as `model` returns them; {error!r}") from error


def _read_only(array: Array) -> Array:
    copy = np.array(array, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def _array(value: object) -> Array:
    return _read_only(value if isinstance(value, np.ndarray) else array_from_wire(value, "model"))
