"""A worker's publication about one trial, checked before it is drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from crkr.protocol import Geom, Invalid, Trace, geoms_from_wire
from crkr.protocol.checks import choice, flag, integer, number, required, text
from crkr.protocol.messages.telemetry import SHAPES
from crkr.protocol.trial import KINDS

__all__ = ["Telemetry"]

# More than an honest message of 64 kB holds. A hostile one must not draw a huge or endless scene.
MAX_GEOMS: Final = 1000
MAX_NAMES: Final = 256
MAX_DURATION_S: Final = 600.0
MAX_DISTANCE_M: Final = 1e5


@final
@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """One message of pub/trial or pub/evaluation.

    Attributes:
        seq: The trial's log position.
        worker: The worker that executed it.
        kind: "trial", "demonstration", "evaluation" or "failed".
        success: What the skill chose to learn from.
        sigma_mean: Mean over the goal's dimensions of sigma / scale, or None.
        novelty: In [0, 1], or None.
        timing_ms: Durations of the trial's phases by name, e.g. "predict" [ms].
        trace: How things moved, or None.
        scene: The shapes, or None if the worker sent them before.
    """

    seq: int
    worker: str
    kind: str
    success: bool
    sigma_mean: float | None
    novelty: float | None
    timing_ms: Mapping[str, float]
    trace: Trace | None
    scene: tuple[Geom, ...] | None

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Telemetry:
        """Read a message.

        Raises:
            Invalid: A field cannot be drawn.
        """
        trace, scene = message.get("trace"), message.get("scene")
        return cls(
            seq=integer(required(message, "seq"), "seq"),
            worker=text(required(message, "worker"), "worker", longest=128),
            kind=choice(required(message, "kind"), "kind", KINDS),
            success=flag(required(message, "success"), "success"),
            sigma_mean=_optional_number(message.get("sigma_mean"), "sigma_mean"),
            novelty=_optional_number(message.get("novelty"), "novelty"),
            timing_ms=_timing(message.get("timing")),
            trace=None if trace is None else _trace(trace),
            scene=None if scene is None else _scene(scene),
        )


def _optional_number(value: object, name: str) -> float | None:
    """A number, or None for NaN and null."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    return number(value, name)


def _timing(value: object) -> dict[str, float]:
    if value is None:
        return {}
    if not isinstance(value, Mapping) or len(value) > 16:
        raise Invalid(f"timing must be a map of at most 16 durations; got {value!r:.80}")
    return {
        text(name, "timing", longest=32).removesuffix("_ms"): number(duration, f"timing.{name}", low=0.0, high=1e9)
        for name, duration in value.items()
        if duration is not None
    }


def _trace(value: object) -> Trace:
    if not isinstance(value, Mapping) or not isinstance(value.get("paths", {}), Mapping):
        raise Invalid(f"trace must be a map of poses and paths; got {value!r:.80}")
    if not isinstance(value.get("bodies"), list):
        raise Invalid("trace.bodies must be a list of names")
    if len(value["bodies"]) > MAX_NAMES or len(value.get("paths", {})) > MAX_NAMES:
        raise Invalid(f"a trace has at most {MAX_NAMES} bodies and {MAX_NAMES} paths")
    trace = Trace.from_wire(value)
    if len(set(trace.bodies)) < len(trace.bodies):
        raise Invalid("trace.bodies must differ")
    if len(trace.time) == 0:
        raise Invalid("trace.time must have at least one entry")
    if (np.diff(trace.time) < 0).any() or trace.time[-1] - trace.time[0] > MAX_DURATION_S:
        raise Invalid(f"trace.time must increase and last at most {MAX_DURATION_S:.0f} s")
    for points in (trace.positions, *trace.paths.values()):
        if (np.abs(points) > MAX_DISTANCE_M).any():
            raise Invalid(f"trace must stay within {MAX_DISTANCE_M:.0f} m")
    if (np.abs(np.linalg.norm(trace.quaternions, axis=-1) - 1) > 0.01).any():
        raise Invalid("trace.quaternions must have unit length")
    return trace


def _scene(value: object) -> tuple[Geom, ...]:
    if not isinstance(value, list) or len(value) > MAX_GEOMS or not all(isinstance(entry, Mapping) for entry in value):
        raise Invalid(f"scene must be a list of at most {MAX_GEOMS} shapes; got {value!r:.80}")
    geoms = geoms_from_wire(value)
    for geom in geoms:
        choice(geom.shape, "shape", SHAPES)
        if max(map(abs, (*geom.size, *geom.position))) > MAX_DISTANCE_M or min(geom.size) < 0:
            raise Invalid(f"sizes must be in [0, {MAX_DISTANCE_M:.0f}] m, and positions near; got {geom}")
        if abs(math.hypot(*geom.quaternion) - 1) > 0.01:
            raise Invalid(f"a shape's quaternion must have unit length; got {geom.quaternion}")
    return geoms
