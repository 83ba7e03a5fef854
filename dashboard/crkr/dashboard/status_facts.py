"""Facts for the tables of all displays. Reads the server's status leniently: fields may be added or absent."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.dashboard.progress import Progress

__all__ = [
    "WorkerFacts",
    "advice_lines",
    "drift_score",
    "latency_ms",
    "percent",
    "reason_rows",
    "recent_workers",
    "server_time",
    "worker_rows",
]

UNKNOWN: Final = "unknown"
GONE_S: Final = 600.0


@final
@dataclass(frozen=True, slots=True)
class WorkerFacts:
    """One worker.

    Attributes:
        name: Its id.
        state: As in the server's status, "alive" while its liveliness token is declared; "unknown" if only the log
            knows it.
        trials: Trials that it reported, of all kinds.
        quiet_s: Time since its last message [s], or None.
    """

    name: str
    state: str
    trials: int
    quiet_s: float | None


def worker_rows(status: Mapping[str, Any], progress: Progress, status_age_s: float) -> list[WorkerFacts]:
    """The server's workers, those alive first, then those that only the log knows.

    Args:
        status: The server's answer; its ages are by its own monotonic clock.
        progress: The run so far.
        status_age_s: Age of that answer [s].
    """
    listed = status.get("workers")
    entries = [entry for entry in listed if isinstance(entry, Mapping)] if isinstance(listed, list) else []
    facts = {
        str(entry.get("id")): WorkerFacts(
            str(entry.get("id")),
            _state(entry.get("state")),
            progress.workers[str(entry.get("id"))],
            entry["last_seen_s"] + status_age_s if isinstance(entry.get("last_seen_s"), int | float) else None,
        )
        for entry in entries
    }
    for name, trials in progress.workers.items():
        if name:
            facts.setdefault(name, WorkerFacts(name, UNKNOWN, trials, None))
    return sorted(facts.values(), key=lambda worker: (worker.state != "alive", worker.name))


def _state(word: object) -> str:
    return word if isinstance(word, str) else UNKNOWN


def reason_rows(progress: Progress) -> list[tuple[str, int, float, float]]:
    """(reason, count, share, share of the last 50) of training trials, the most frequent of the last 50 first."""
    total = max(sum(progress.reasons.values()), 1)
    rows = [(reason, count, count / total, progress.window.share(reason)) for reason, count in progress.reasons.items()]
    return sorted(rows, key=lambda row: (-row[3], -row[1], row[0]))


def advice_lines(status: Mapping[str, Any]) -> list[str]:
    """What limits learning, by the server's rules."""
    listed = status.get("advice")
    entries = listed if isinstance(listed, list) else []
    return [str(one["message"]) for one in entries if isinstance(one, Mapping) and "message" in one]


def drift_score(status: Mapping[str, Any]) -> float | None:
    """How far outcomes are from what was predicted: above 20 the robot has changed. None: not watched."""
    drift = status.get("drift")
    score = drift.get("score") if isinstance(drift, Mapping) else None
    return float(score) if isinstance(score, int | float) else None


def latency_ms(status: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """The server's own time per verb: name -> (median, 99th percentile) [ms]."""
    latency = status.get("latency_us")
    found = {}
    for verb, numbers in latency.items() if isinstance(latency, Mapping) else ():
        p50, p99 = (numbers.get("p50"), numbers.get("p99")) if isinstance(numbers, Mapping) else (None, None)
        if isinstance(p50, int | float) and isinstance(p99, int | float):
            found[str(verb)] = (p50 / 1000, p99 / 1000)
    return found


def server_time(status: Mapping[str, Any], age_s: float) -> float:
    """The current time by the server's clock [unix s]; by this machine's if an older server does not send it."""
    told = status.get("time")
    return float(told) + age_s if isinstance(told, int | float) else time.time()


def recent_workers(workers: Sequence[WorkerFacts], most: int) -> tuple[list[WorkerFacts], int]:
    """At most `most` workers that are alive or were heard in the last ten minutes, and the number of others."""
    shown = [worker for worker in workers if worker.state == "alive" or (worker.quiet_s or 0.0) < GONE_S][:most]
    return shown, len(workers) - len(shown)


def percent(share: float | None) -> str:
    """A share as text, "-" for None."""
    return "-" if share is None else f"{100 * share:.0f} %"
