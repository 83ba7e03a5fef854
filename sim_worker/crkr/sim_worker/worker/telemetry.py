"""A worker's publications about stored trials; they may be dropped, and learning never waits for them."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np

from crkr.client import Task
from crkr.protocol import Geom, Invalid, Prediction, Trace, Trial, geoms_to_wire

__all__ = ["Telemetry", "Timing", "thinned"]

logger = logging.getLogger(__name__)

TRACE_HZ: Final = 30.0
SCENE_EVERY_S: Final = 2.0


@final
@dataclass(frozen=True, slots=True)
class Timing:
    """Wall time of a trial's steps [ms]."""

    predict_ms: float
    execute_ms: float
    report_ms: float

    def to_wire(self) -> dict[str, float]:
        """The times as a message map."""
        return {"predict_ms": self.predict_ms, "execute_ms": self.execute_ms, "report_ms": self.report_ms}


def thinned(trace: Trace, rate_hz: float = TRACE_HZ) -> Trace:
    """The trace with at most `rate_hz` poses a second; first and last are kept."""
    if len(trace.time) < 3 or (len(trace.time) - 1) <= 1.5 * rate_hz * (trace.time[-1] - trace.time[0]):
        return trace
    wanted = np.arange(trace.time[0], trace.time[-1], 1.0 / rate_hz)
    keep = np.unique(np.append(np.searchsorted(trace.time, wanted), len(trace.time) - 1))
    return replace(
        trace,
        time=trace.time[keep],
        positions=trace.positions[keep],
        quaternions=trace.quaternions[keep],
        paths={name: path[keep] for name, path in trace.paths.items()},
    )


@final
class Telemetry:
    """Publishes a worker's trials: poses at most 30 times a second, the static scene first and at most every 2 s."""

    def __init__(self, task: Task, scene: Sequence[Geom]) -> None:
        self._task = task
        self._scene = geoms_to_wire(scene)
        self._scales = task.spec.scales
        self._next_trace = self._next_scene = 0.0

    def publish(
        self,
        trial: Trial,
        seq: int,
        *,
        trace: Trace | None = None,
        sigma: np.ndarray[Any, np.dtype[np.float64]] | None = None,
        novelty: float | None = None,
        timing: Timing | None = None,
    ) -> None:
        """Publishes one stored trial; never waits, never fails for a lost connection."""
        now = time.monotonic()
        message = {**trial.to_wire(), "seq": seq, "time": time.time()}
        if sigma is not None:
            message["sigma"] = sigma
            message["sigma_mean"] = float(np.mean(sigma / self._scales))
        if novelty is not None:
            message["novelty"] = novelty
        if timing is not None:
            message["timing"] = timing.to_wire()
        self._publish("evaluation" if trial.kind == "evaluation" else "trial", message, self._pictures(trace, now))

    def refused(self, answer: Prediction, worker: str) -> None:
        """Publishes that a goal was refused; the log has no such trial, so the message has no `seq`."""
        self._task.publish(
            "trial",
            {
                "id": answer.trial_id,
                "state": answer.state,
                "goal": answer.goal,
                "cost": None,
                "success": False,
                "kind": "failed",
                "worker": worker,
                "info": {"reason": "invalid"},
                "time": time.time(),
            },
        )

    def _pictures(self, trace: Trace | None, now: float) -> dict[str, Any]:
        pictures: dict[str, Any] = {}
        try:
            self._draw(pictures, trace, now)
        except (ValueError, IndexError, TypeError) as error:  # the arrays of a trace do not fit each other
            logger.debug("a trial's trace cannot be drawn: %s", error)
        return pictures

    def _draw(self, pictures: dict[str, Any], trace: Trace | None, now: float) -> None:
        if trace is not None and now >= self._next_trace:
            self._next_trace = now + 1.0 / TRACE_HZ
            pictures["trace"] = thinned(trace).to_wire()
        if self._scene and now >= self._next_scene:
            self._next_scene = now + SCENE_EVERY_S
            pictures["scene"] = self._scene

    def _publish(self, topic: str, message: Mapping[str, Any], pictures: Mapping[str, Any]) -> None:
        try:
            self._task.publish(topic, {**message, **pictures})
        except Invalid:  # too large with its pictures: publish the numbers alone
            self._task.publish(topic, message)
