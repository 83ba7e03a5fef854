"""`crkr bench tasks`: what a task costs where there are many others."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer

from crkr.client.bench import workload
from crkr.client.bench.figures import Figure, p50, show
from crkr.client.bench.processes import serving
from crkr.client.bench.timing import in_turns
from crkr.client.cli.options import Json
from crkr.client.client import Client
from crkr.protocol import Array

__all__ = ["task_figures", "tasks"]

_ROUNDS: Final = 100  # first answers


def tasks(
    count: Annotated[int, typer.Option("--tasks", min=20, help="How many tasks the larger server has.")] = 2000,
    as_json: Json = False,
) -> None:
    """Measure a new client's first answer, and the making of a task, beside many other tasks.

    Example: crkr bench tasks --tasks 500
    """
    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as directory:
        figures = list(task_figures(Path(directory), count))
    show(figures, f"one task of {count}, d = {workload.D}, p = {workload.P}, loopback", as_json)


def task_figures(directory: Path, count: int) -> Iterator[Figure]:
    """Compares a server of `count` tasks with one of a single task, then restarts it."""
    many = directory / "many"
    with ExitStack() as stack:
        one = stack.enter_context(serving(directory / "one"))
        crowded = stack.enter_context(serving(many))
        _make(one, 1)
        made = _make(crowded, count)
        for client in (one, crowded):
            workload.fill(client.task(workload.TASK), workload.BUDGET)
        few = max(count // 10, 1)
        first, last = p50(made[:few]), p50(made[-few:])
        behind = {"last us": last, "first us": first}
        yield Figure(f"create_task p50: the last {few} / the first {few}", last / first, 1.2, False, behind)
        calls = {"many": lambda: _first_answer(crowded.endpoint), "one": lambda: _first_answer(one.endpoint)}
        times = {name: p50(taken) for name, taken in in_turns(calls, _ROUNDS, 1).items()}
        behind = {"many us": times["many"], "one us": times["one"]}
        what = f"a new client's first answer p50: {count} tasks / one"
        yield Figure(what, times["many"] / times["one"], 1.1, False, behind)
    started = time.perf_counter()
    with serving(many) as client:
        client.task(workload.TASK).predict(workload.states(1)[0])
        seconds = time.perf_counter() - started
    yield Figure(f"restart of {count} tasks to the first answer / 20 s", seconds / 20.0, 1.0, False, {"s": seconds})


def _make(client: Client, count: int) -> Array:
    """Makes the workload's task and more of its size; the time of each [s]."""
    spec = workload.bench_spec()
    taken = np.empty(count)
    for number in range(count):
        name = workload.TASK if number == count // 2 else f"{workload.TASK}-{number}"
        started = time.perf_counter()
        client.create_task(replace(spec, name=name))
        taken[number] = time.perf_counter() - started
    return taken


def _first_answer(endpoint: str) -> None:
    """From nothing to a prediction, as a process that starts."""
    with Client(endpoint) as client:
        client.task(workload.TASK).predict(workload.states(1)[0])
