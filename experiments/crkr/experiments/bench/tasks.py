"""What `crkr bench tasks` measures: one task on a server with many others, beside a server with that task alone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from crkr.client import Client
from crkr.experiments.bench import workload
from crkr.experiments.bench.measurements import Measurement, in_turns, p50, ratio
from crkr.experiments.bench.processes import running_server
from crkr.protocol import Array

__all__ = ["measure"]

_ROUNDS: Final = 100  # first answers
_RESTART_S: Final = 20.0


def measure(directory: Path, count: int) -> Iterator[Measurement]:
    """All figures.

    Args:
        directory: Empty; for the servers' data.
        count: Tasks of the larger server.
    """
    many = directory / "many"
    with ExitStack() as stack:
        one = stack.enter_context(running_server(directory / "one"))
        crowded = stack.enter_context(running_server(many))
        _make(one, 1)
        made = _make(crowded, count)
        for client in (one, crowded):
            workload.fill(client.task(workload.TASK), workload.BUDGET)
        few = max(count // 10, 1)
        times = {"last": p50(made[-few:]), "first": p50(made[:few])}
        yield ratio(f"create_task p50: the last {few} / the first {few}", times, "last", "first", 1.2)
        calls = {"many": lambda: _first_answer(crowded.endpoint), "one": lambda: _first_answer(one.endpoint)}
        times = {name: p50(taken) for name, taken in in_turns(calls, _ROUNDS, 1).items()}
        yield ratio(f"a new client's first answer p50: {count} tasks / one", times, "many", "one", 1.1)
    started = time.perf_counter()
    with running_server(many) as client:
        client.task(workload.TASK).predict(workload.states(1)[0])
        seconds = time.perf_counter() - started
    what = f"restart of {count} tasks to the first answer / {_RESTART_S:.0f} s"
    yield Measurement(what, seconds / _RESTART_S, 1.0, behind={"s": seconds})


def _make(client: Client, count: int) -> Array:
    """Create the workload's task and others of its size; the time of each [s]."""
    spec = workload.bench_spec()
    taken = np.empty(count)
    for number in range(count):
        name = workload.TASK if number == count // 2 else f"{workload.TASK}-{number}"
        started = time.perf_counter()
        client.create_task(replace(spec, name=name))
        taken[number] = time.perf_counter() - started
    return taken


def _first_answer(endpoint: str) -> None:
    """Connect a new client and predict, as a process that starts does."""
    with Client(endpoint) as client:
        client.task(workload.TASK).predict(workload.states(1)[0])
