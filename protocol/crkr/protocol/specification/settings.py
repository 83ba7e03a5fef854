"""The nested settings of a task: its kernel and its way to explore."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.protocol.checks import choice, flag, integer, number
from crkr.protocol.errors import Invalid, shown

__all__ = ["EARLIER_EXPLORATION", "LARGEST", "Exploration", "KernelSettings", "Start"]

LARGEST: Final = 1e6  # of a setting in scaled units; larger products overflow
MOST_TRIALS: Final = 20_000  # of trials to search for


def _map(value: object, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise Invalid(f"{name} must be a map; got {type(value).__name__}")
    return value


@final
@dataclass(frozen=True, slots=True)
class KernelSettings:
    """Squared-exponential kernel with one length-scale per dimension, and an optional linear term.

    Attributes:
        type: "se-ard", the only one.
        signal_variance: Variance of the scaled goals before any sample.
        linear_weight: Weight of the linear term z.z'; 0 is the paper's kernel.
    """

    type: str = "se-ard"
    signal_variance: float = 1.0
    linear_weight: float = 0.0

    @classmethod
    def from_dict(cls, value: object) -> KernelSettings:
        """Reads a spec's `kernel`; raises `Invalid`."""
        entry = _map(value, "kernel")
        return cls(
            choice(entry.get("type", "se-ard"), "kernel.type", ("se-ard",)),
            number(entry.get("signal_variance", 1.0), "kernel.signal_variance", above=0.0, high=LARGEST),
            number(entry.get("linear_weight", 0.0), "kernel.linear_weight", low=0.0, high=LARGEST),
        )


@final
@dataclass(frozen=True, slots=True)
class Exploration:
    """How `explore` draws a goal.

    Attributes:
        type: "gaussian" (the paper) or "outcome" (guided by measured outcomes).
        trust: Standard deviations by which the outcome model may move the mean.
        temperature: Scales of the draw, one chosen per trial.
        neighbours: Trials that each local outcome model is fitted to; more than 200 count as 200.
        iterations: Updates of the goal by the outcome model.
        min_trials: Executed trials before the outcome model is used.
        gate: Predicted outcome, in tolerances, above which the mean is corrected.
        model: Local outcome model: "gp", a Gaussian process, "line" or "quadratic".
        candidates: Goals compared for an answer without exploration, besides the mean and the corrected goal.
        drift: Restart the outcome model when the robot has changed.
    """

    type: str = "gaussian"
    trust: float = 4.0
    temperature: tuple[float, ...] = (0.02, 0.1, 0.5)
    neighbours: int = 100
    iterations: int = 3
    min_trials: int = 6
    gate: float = 1.0
    model: str = "gp"
    candidates: int = 32
    drift: bool = True

    @classmethod
    def from_dict(cls, value: object) -> Exploration:
        """Reads a spec's `exploration`; raises `Invalid`."""
        entry = _map(value, "exploration")
        temperatures = entry.get("temperature", [0.02, 0.1, 0.5])
        if not isinstance(temperatures, list | tuple) or not temperatures:
            raise Invalid(f"exploration.temperature must be a list of numbers; got {shown(temperatures)}")
        return cls(
            choice(entry.get("type", "gaussian"), "exploration.type", ("gaussian", "outcome")),
            number(entry.get("trust", 4.0), "exploration.trust", above=0.0, high=LARGEST),
            tuple(number(item, "exploration.temperature", above=0.0, high=LARGEST) for item in temperatures),
            integer(entry.get("neighbours", 100), "exploration.neighbours", low=1, high=MOST_TRIALS),
            integer(entry.get("iterations", 3), "exploration.iterations", low=1, high=100),
            integer(entry.get("min_trials", 6), "exploration.min_trials", low=1, high=MOST_TRIALS),
            number(entry.get("gate", 1.0), "exploration.gate", low=0.0),
            choice(entry.get("model", "gp"), "exploration.model", ("gp", "line", "quadratic")),
            integer(entry.get("candidates", 32), "exploration.candidates", low=0, high=1000),
            flag(entry.get("drift", True), "exploration.drift"),
        )


# Defaults of version 0.1.
EARLIER_EXPLORATION: Final = Exploration(
    "outcome", temperature=(0.1, 0.5), neighbours=60, iterations=2, min_trials=20, gate=2.0
)


@final
@dataclass(frozen=True, slots=True)
class Start:
    """Exploration before the first success.

    Attributes:
        type: "space-filling": a low-discrepancy sequence over the goal's bounds, until outcomes or successes guide; or
            "demonstrations": nothing, `NO_SAMPLES` asks for a demonstration.
        count: Trials that fill the space even if something is known.
    """

    type: str = "space-filling"
    count: int = 0

    @classmethod
    def from_dict(cls, value: object) -> Start:
        """Reads a spec's `start`; raises `Invalid`."""
        entry = _map(value, "start")
        return cls(
            choice(entry.get("type", "space-filling"), "start.type", ("space-filling", "demonstrations")),
            integer(entry.get("count", 0), "start.count", low=0, high=MOST_TRIALS),
        )
