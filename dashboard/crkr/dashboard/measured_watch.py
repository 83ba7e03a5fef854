"""A `crkr watch` that measures itself; `crkr bench dashboard` runs it as a process.

It follows a task like the command, and draws into a recording or, as a baseline, not at all. It ends with its standard
input, and then prints its measurements as one JSON object.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from array import array
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import typer

from crkr.client import Client, Subscription
from crkr.dashboard.command import LOOPBACK, PICTURES_S, STREAM_PORT
from crkr.dashboard.feed import Feed, View
from crkr.dashboard.live_session import follow
from crkr.dashboard.progress import Progress, Row
from crkr.dashboard.telemetry import Telemetry
from crkr.dashboard.viewer import choose_port

__all__ = ["Meter", "growth", "main"]

CLOSE_S: Final = 10.0
LISTEN_S: Final = 0.2
STATM: Final = Path("/proc/self/statm")


@final
class Meter:
    """A view that measures another one's delay and the size of the process.

    Args:
        view: The other one; None draws nothing.
        arrivals: Log position -> when its publication was received [monotonic s]; removed when drawn.

    Attributes:
        lags: Time from there until it was drawn [s].
        sizes: (time [monotonic s], resident bytes, trials) each second; empty where the system does not say.
    """

    def __init__(self, view: View | None, arrivals: dict[int, float]) -> None:
        self._view = view
        self._arrivals = arrivals
        self._fresh: list[int] = []
        self.lags = array("d")  # 8 bytes each, as memory is measured too
        self.sizes: list[tuple[float, float, int]] = []
        self.task: Callable[..., None] = getattr(view, "task", _ignore)
        self.trials: Callable[..., None] = getattr(view, "trials", _ignore)
        self.epoch: Callable[..., None] = getattr(view, "epoch", _ignore)
        self.status: Callable[..., None] = getattr(view, "status", _ignore)
        self.say: Callable[..., None] = getattr(view, "say", _ignore)

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """Pass it on; it is drawn with the next tick at the latest."""
        if self._view is not None:
            self._view.picture(row, telemetry)
        self._fresh.append(row.seq)

    def tick(self, now: float, progress: Progress) -> None:
        """Pass it on, and note the time after it."""
        if self._view is not None:
            self._view.tick(now, progress)
        after = time.monotonic()
        received = [self._arrivals.pop(seq, after) for seq in self._fresh]
        self.lags.extend([after - moment for moment in received])
        self._fresh.clear()
        if STATM.exists() and (not self.sizes or after - self.sizes[-1][0] >= 1.0):
            resident = int(STATM.read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGESIZE")
            self.sizes.append((after, resident, progress.trials))


def _ignore(*_: object, **__: object) -> None:
    """Draw nothing."""


def main(endpoint: str, task: str, save: Path | None = None, memory_limit: str = "512MiB") -> None:
    """Follow a task until standard input ends; with `save` draw into a recording, which is also served."""
    ended = threading.Event()
    with ExitStack() as stack:
        client = stack.enter_context(Client(endpoint))
        followed = client.task(task)
        arrivals: dict[int, float] = {}
        meter = Meter(_drawing(stack, task, save, memory_limit) if save else None, arrivals)
        heard = stack.enter_context(followed.subscribe(("trial",)))
        listening = threading.Thread(target=_listen, args=(heard, arrivals, ended), daemon=True)
        waiting = threading.Thread(target=_wait_for_end, args=(ended.set,), daemon=True)
        for thread in (listening, waiting):
            thread.start()
        feed = Feed(meter)
        follow(client, followed, feed, PICTURES_S, lambda: not ended.is_set())
        listening.join()
    sys.stdout.write(json.dumps(_summary(meter, feed, save)) + "\n")


def _drawing(stack: ExitStack, task: str, save: Path, memory_limit: str) -> View:
    from crkr.dashboard.rerun_view import Recording, RerunDisplay

    recording = Recording((LOOPBACK, choose_port(LOOPBACK, None, STREAM_PORT, stack)), save, memory_limit)
    stack.callback(recording.close, CLOSE_S)
    return RerunDisplay(recording, task)


def _listen(subscription: Subscription, arrivals: dict[int, float], ended: threading.Event) -> None:
    """Note when publications arrive, in a thread beside the display."""
    while not ended.is_set():
        received = subscription.receive(LISTEN_S)
        if received is not None and isinstance(seq := received[1].get("seq"), int):
            arrivals[seq] = time.monotonic()


def _wait_for_end(told: Callable[[], object]) -> None:
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.read()
    told()


def _summary(meter: Meter, feed: Feed, save: Path | None) -> dict[str, Any]:
    lag = 1e3 * np.percentile(meter.lags, [50, 99]) if meter.lags else [np.nan, np.nan]
    more = growth(meter.sizes)
    return {
        "lag_p50_ms": float(lag[0]),
        "lag_p99_ms": float(lag[1]),
        "drawn": len(meter.lags),
        "dropped": feed.dropped,
        "bytes_a_second": more[0],
        "bytes_a_trial": more[1],
        "recording_bytes": save.stat().st_size if save else 0,
    }


def growth(sizes: Sequence[tuple[float, float, int]]) -> tuple[float, float]:
    """Slopes of the resident bytes over time and over trials, of the last two thirds; nan for too few."""
    late = np.array(sizes[len(sizes) // 3 :], dtype=np.float64)
    if len(late) < 3 or np.ptp(late[:, 2]) == 0:
        return float("nan"), float("nan")
    return float(np.polyfit(late[:, 0], late[:, 1], 1)[0]), float(np.polyfit(late[:, 2], late[:, 1], 1)[0])


if __name__ == "__main__":
    typer.run(main)
