"""What `crkr bench dashboard` measures, in two parts on one server.

First real workers, in turn unwatched, followed by a program that draws nothing, and watched. Then a steady stream of
trials, with those workers' publications, to a program that draws and to one that does not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final

import numpy as np

from crkr.client import Client, Task
from crkr.experiments.bench import workload
from crkr.experiments.bench.measurements import Measurement, ratio
from crkr.experiments.bench.processes import Child, command, program, running_server
from crkr.protocol import Unavailable, UnknownTask, pack

__all__ = ["STREAM", "WATCH", "measure"]

WATCH: Final = "crkr.dashboard.measured_watch"
STREAM: Final = "crkr.experiments.bench.stream"
ROUNDS: Final = 3
ROUND_S: Final = 2.5
STREAM_S: Final = 15.0
RATE: Final = 200  # trials a second
WARM: Final = 150  # trials of the workers before anything is measured
WARM_S: Final = 60.0
LOOK_S: Final = 0.1
CAPTURED: Final = 100


def measure(directory: Path, skill: str, workers: int) -> Iterator[Measurement]:
    """All figures."""
    with running_server(directory / "data") as client:
        yield from _beside_workers(client, directory, skill, workers)
        yield from _beside_stream(client, directory)


def _beside_workers(client: Client, directory: Path, skill: str, workers: int) -> Iterator[Measurement]:
    name, endpoint = "bench-workers", client.endpoint
    train = ["workers", skill, "--task", name, "-n", str(workers), "--trials", "1000000", "--connect", endpoint]
    watch = ["watch", name, "--connect", endpoint, "--save", str(directory / "workers.rrd"), "--overwrite"]
    conditions: dict[str, Callable[[], AbstractContextManager[Any]]] = {
        "unwatched": nullcontext,
        "followed": lambda: program(WATCH, endpoint, name),
        "watched": lambda: command(watch, "caught up"),
    }
    rates: dict[str, list[float]] = {condition: [] for condition in conditions}
    with command(train) as training:
        task = client.task(name)
        _warm(task, training)
        (directory / "messages").write_bytes(pack({"messages": _published_trials(task)}))
        for turn in range(ROUNDS):
            for place in range(len(conditions)):  # each is first, second and last once
                condition = list(conditions)[(turn + place) % len(conditions)]
                with conditions[condition]():
                    rates[condition].append(_rate(task))
    middle = {condition: float(np.median(found)) for condition, found in rates.items()}
    behind = {"workers": float(workers), **{f"{condition} /s": rate for condition, rate in middle.items()}}
    behind["unwatched, least /s"], behind["most /s"] = min(rates["unwatched"]), max(rates["unwatched"])
    what = "workers' trials a second, watched / unwatched"
    yield Measurement(what, middle["watched"] / middle["unwatched"], None, True, behind)
    yield Measurement("  the same, followed without drawing", middle["followed"] / middle["unwatched"], None, True)


def _warm(task: Task, training: Child) -> None:
    """Wait until the workers have made some trials."""
    deadline = time.monotonic() + WARM_S
    while time.monotonic() < deadline:
        training.check()
        try:
            if task.status()["seq"] >= WARM:
                return
        except UnknownTask:  # the workers create it
            pass
        time.sleep(LOOK_S)
    raise Unavailable(f"the workers did not get to {WARM} trials within {WARM_S:.0f} s")


def _published_trials(task: Task) -> list[bytes]:
    """Publications of the workers about the next trials, packed."""
    found: list[bytes] = []
    deadline = time.monotonic() + WARM_S
    with task.subscribe(("trial",)) as subscription:
        while len(found) < CAPTURED:
            received = subscription.receive(max(0.0, deadline - time.monotonic()))
            if received is None:
                raise Unavailable(f"the workers published {len(found)} trials within {WARM_S:.0f} s, not {CAPTURED}")
            found.append(pack(received[1]))
    return found


def _rate(task: Task) -> float:
    """Trials of all kinds a second [1/s]."""
    begin, before = time.monotonic(), task.status()["seq"]
    time.sleep(ROUND_S)
    end, after = time.monotonic(), task.status()["seq"]
    return float((after - before) / (end - begin))


def _beside_stream(client: Client, directory: Path) -> Iterator[Measurement]:
    endpoint, file = client.endpoint, directory / "stream.rrd"
    with program(STREAM, endpoint, str(directory / "messages"), str(RATE)) as source:
        with (
            program(WATCH, endpoint, workload.TASK, "--save", str(file)) as drawing,
            program(WATCH, endpoint, workload.TASK) as bare,
        ):
            time.sleep(STREAM_S)
            drawn, followed = drawing.finish(), bare.finish()
        sent = source.finish()
    lags = {"drawn": drawn["lag_p50_ms"], "followed": followed["lag_p50_ms"]}
    yield ratio(
        "lag of a picture, received to drawn, p50 / followed without drawing", lags, "drawn", "followed", unit="ms"
    )
    behind = {
        "drawn ms": drawn["lag_p99_ms"],
        "followed ms": followed["lag_p99_ms"],
        "trials /s": sent["published"] / sent["seconds"],
        "pictures dropped": float(drawn["dropped"]),
    }
    yield Measurement("  the same, p99", drawn["lag_p99_ms"] / followed["lag_p99_ms"], behind=behind)
    sizes = {"recorded": drawn["recording_bytes"] / drawn["drawn"], "published": sent["bytes"] / sent["published"]}
    yield ratio("recording, bytes a trial / bytes published", sizes, "recorded", "published", unit="B")
    behind = {
        "drawing B": drawn["bytes_a_trial"],
        "followed B": followed["bytes_a_trial"],
        "drawing MB/min": 60e-6 * drawn["bytes_a_second"],
        "followed MB/min": 60e-6 * followed["bytes_a_second"],
    }
    what = "memory, bytes more a trial / bytes published"
    yield Measurement(what, drawn["bytes_a_trial"] / sizes["published"], behind=behind)
