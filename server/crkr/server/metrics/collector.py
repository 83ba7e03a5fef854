"""Prometheus metrics of a server, read from its state at each scrape."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Final, final

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from crkr.learner.advice import ADVICE_CODES
from crkr.protocol import KINDS, PROTOCOL_VERSION
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.metrics.durations import Durations, Latencies
from crkr.server.thread_faults import FAULTS
from crkr.server.workers import STATES, Workers

__all__ = ["MetricSources", "MetricsCollector"]

# One number for each task: metric, meaning, function of a task.
_OF_A_TASK: Final = {
    "crkr_task_eligible_samples": "Trials that may be learned from.",
    "crkr_task_active_samples": "Trials in the model.",
    "crkr_task_model_version": "Log position that the model has applied.",
    "crkr_task_model_lag": "Log positions that the model has yet to apply.",
    "crkr_task_archived": "1 if the task answers reads only.",
    "crkr_task_faulty": "1 if the task could not be restored, or learns no more until a restart; see the server's log.",
    "crkr_task_success_ratio": "Share of the newest 200 trials that succeeded; NaN without any.",
    "crkr_task_drift_score": "How far outcomes are from what was predicted: above 20 the outcome model restarts.",
    "crkr_task_drift_restarts": "Restarts of the outcome model, as the robot had changed.",
    "crkr_task_damaged": "1 if a stored row is not what was stored; see the server's log.",
}


@final
@dataclass(frozen=True, slots=True)
class MetricSources:
    """Read-only; thread-safe.

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


@final
class MetricsCollector(Collector):
    """Reads one server's state at each scrape."""

    def __init__(self, sources: MetricSources) -> None:
        self._sources = sources
        self._about = {"version": version("crkr"), "protocol": str(PROTOCOL_VERSION)}

    def collect(self) -> Iterator[Metric]:
        """All metrics but the process's own."""
        yield InfoMetricFamily("crkr_build", "What runs.", self._about)
        yield from self._threads()
        yield from self._sources.latencies.collect()
        yield from self._queues()
        yield from self._sources.commits.collect()
        yield from self._sources.learning.steps.collect()
        yield from self._tasks()
        yield from self._workers()
        yield from self._disk()

    def _threads(self) -> Iterator[Metric]:
        faults = CounterMetricFamily(
            "crkr_thread_faults", "What threads of the server raised and survived; see its log.", labels=["thread"]
        )
        # The main threads are listed from the start, so that a rate sees their first fault.
        for thread, count in {"write": 0, "learning": 0, **FAULTS.counts()}.items():
            faults.add_metric([thread], count)
        yield faults
        ended = len(FAULTS.ended())
        yield GaugeMetricFamily("crkr_threads_ended", "Threads that have ended: restart the server.", ended)

    def _queues(self) -> Iterator[Metric]:
        waiting = GaugeMetricFamily("crkr_queue_waiting", "Requests that wait.", labels=["verb"])
        limit = GaugeMetricFamily("crkr_queue_limit", "Requests that may wait; more are BUSY.", labels=["verb"])
        for verb, depth in self._sources.queues().items():
            waiting.add_metric([verb], depth["waiting"])
            limit.add_metric([verb], depth["limit"])
        yield from (waiting, limit)
        backlog = self._sources.learning.backlog
        yield GaugeMetricFamily("crkr_learning_backlog_trials", "Stored trials that wait to be learned from.", backlog)

    def _tasks(self) -> Iterator[Metric]:
        samples = GaugeMetricFamily("crkr_task_samples", "Stored trials.", labels=["task", "kind"])
        single = {name: GaugeMetricFamily(name, text, labels=["task"]) for name, text in _OF_A_TASK.items()}
        advice = GaugeMetricFamily(
            "crkr_task_advice", "1 for what limits learning, by rule; else 0.", labels=["task", "code"]
        )
        for task in self._sources.tasks.all():
            told = {one.code for one in task.advice()}
            for code in ADVICE_CODES:
                advice.add_metric([task.name, code], code in told)
            for kind in KINDS:
                samples.add_metric([task.name, kind], task.samples[kind])
            for metric, value in zip(single.values(), _numbers(task), strict=True):
                metric.add_metric([task.name], value)
        yield from (samples, advice, *single.values())

    def _workers(self) -> Iterator[Metric]:
        workers = GaugeMetricFamily("crkr_task_workers", "Workers by state.", labels=["task", "state"])
        trials = GaugeMetricFamily("crkr_task_open_trials", "Goals given out and not reported yet.", labels=["task"])
        totals = self._sources.workers.totals()
        for task in self._sources.tasks.all():
            states, opened = totals.get(task.name, (Counter[str](), 0))
            for state in STATES:
                workers.add_metric([task.name, state], states[state])
            trials.add_metric([task.name], opened)
        yield from (workers, trials)

    def _disk(self) -> Iterator[Metric]:
        stored, free = self._sources.sizes()
        if stored is not None:
            yield GaugeMetricFamily("crkr_log_bytes", "Size of the task log's files or tables.", stored)
        if free is not None:
            yield GaugeMetricFamily("crkr_disk_free_bytes", "Room for the task log.", free)


def _numbers(task: ServedTask) -> tuple[float, ...]:
    """In the order of the table above."""
    model = task.model  # before the log position, which is only ever ahead
    lag = task.seq - model.version
    rate, drift = task.history.trend().rate, task.drift
    success = float("nan") if rate is None else rate
    drifted = (0.0, 0) if drift is None else (drift.score, drift.restarts)
    faulty, damaged = bool(task.fault), bool(task.damage)
    return task.eligible, model.active, model.version, lag, task.archived, faulty, success, *drifted, damaged
