"""Where the metrics of a server are read from; apart from the collector, which needs the Prometheus client."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.metrics.durations import Durations, Latencies
from crkr.server.workers import Workers

__all__ = ["MetricSources"]


@final
@dataclass(frozen=True, slots=True)
class MetricSources:
    """Read only; any thread may.

    Attributes:
        sizes: Gives the bytes of the log, and those free for it; None where unknown.
        tasks: What is served.
        latencies: Times and errors of the answers.
        workers: The workers of each task.
        learning: The backlog and the steps of learning.
        commits: How long the log took to store.
        queues: Verb -> {waiting, limit}.
    """

    sizes: Callable[[], tuple[int | None, int | None]]
    tasks: Tasks
    latencies: Latencies
    workers: Workers
    learning: Learning
    commits: Durations
    queues: Callable[[], Mapping[str, Any]]
