"""`crkr bench predict`: what an answer costs above the bare wire, alone, in crowds and beside others' load."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer

from crkr.client.bench import workload
from crkr.client.bench.bare import Bare
from crkr.client.bench.echo import KEY
from crkr.client.bench.figures import Figure, p50, p99, show
from crkr.client.bench.processes import Load, echoing, loading, serving
from crkr.client.bench.restart import restart_figures
from crkr.client.bench.timing import in_turns, spell
from crkr.client.cli.options import Json
from crkr.client.client import Client
from crkr.client.task import Task
from crkr.protocol import Array

if TYPE_CHECKING:
    from crkr.client.mirror import Mirror  # needs an extra, and the command says which

__all__ = ["predict"]

_SAMPLES: Final = 1000
_RECEIPT: Final = 60  # bytes of a report's reply
_FLOOD: Final = 700  # explain requests at once
_MANY: Final = 20_000  # queries of a throughput


def predict(
    samples: Annotated[
        int, typer.Option("--samples", min=0, help="Also restart on a log of so many samples; 1000000 takes minutes.")
    ] = 0,
    as_json: Json = False,
) -> None:
    """Measure predictions beside a bare Zenoh echo of the same bytes.

    Example: crkr bench predict --samples 100000
    """
    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as directory:
        figures = list(_all(Path(directory)))
        if samples:
            figures += restart_figures(Path(directory), samples)
    show(figures, f"predict, m = 250, d = {workload.D}, p = 13, loopback", as_json)


def _all(directory: Path) -> Iterator[Figure]:
    with ExitStack() as stack:
        client = stack.enter_context(serving(directory / "data"))
        task = client.create_task(workload.bench_spec())
        workload.fill(task, _SAMPLES)
        payload = workload.predict_payload()
        bare = stack.enter_context(Bare(client.endpoint, workload.key("predict")))
        size = len(bare.ask(payload))
        echo = stack.enter_context(Bare(stack.enter_context(echoing(size)), KEY))
        least = stack.enter_context(Bare(stack.enter_context(echoing(size, workload.BUDGET)), KEY))
        with task.mirror() as mirror:
            yield from _alone(task, mirror, bare, echo, least, payload)
        yield _in_flight(bare, echo, payload)
        yield _thousand(task)
        yield from _beside_reports(stack, client, task, echo, payload)
        yield from _beside_flood(stack, client, task, echo, payload)


def _alone(task: Task, mirror: Mirror, bare: Bare, echo: Bare, least: Bare, payload: bytes) -> Iterator[Figure]:
    state = workload.states(1)[0]
    calls = {
        "predict": lambda: task.predict(state),
        "wire": lambda: bare.ask(payload),
        "least": lambda: least.ask(payload),
        "echo": lambda: echo.ask(payload),
        "mirror": lambda: mirror.predict(state),
    }
    times = {name: p50(found) for name, found in in_turns(calls, 20, 150).items()}
    behind = {"predict us": times["predict"], "echo us": times["echo"]}
    yield Figure("Task.predict p50 / echo p50, one in flight", times["predict"] / times["echo"], 1.15, False, behind)
    behind = {"wire us": times["wire"], "echo us": times["echo"]}
    yield Figure("  the same bytes asked by bare Zenoh / echo", times["wire"] / times["echo"], None, False, behind)
    behind = {"least us": times["least"], "echo us": times["echo"]}
    yield Figure("  the bare arithmetic behind bare Zenoh / echo", times["least"] / times["echo"], None, False, behind)
    behind = {"mirror us": times["mirror"], "echo us": times["echo"]}
    yield Figure("  Mirror.predict, no network / echo", times["mirror"] / times["echo"], None, False, behind)


def _in_flight(bare: Bare, echo: Bare, payload: bytes) -> Figure:
    rates: dict[str, list[float]] = {"predict": [], "echo": []}
    for _ in range(4):
        for name, one in (("predict", bare), ("echo", echo)):
            rates[name].append(one.rate(repeat(payload, _MANY // 4), 64))
    ours, theirs = (float(np.median(rates[name])) for name in ("predict", "echo"))
    behind = {"predict /s": ours, "echo /s": theirs}
    return Figure("predict rate / echo rate, 64 in flight", ours / theirs, 0.6, True, behind)


def _thousand(task: Task) -> Figure:
    many, one = workload.states(1000), workload.states(1)[0]
    found = in_turns({"many": lambda: task.predict(many), "one": lambda: task.predict(one)}, 10, 10)
    times = {name: p50(taken) for name, taken in found.items()}
    behind = {"1000 us": times["many"], "1 us": times["one"]}
    return Figure("1000 states in one predict / one state", times["many"] / times["one"], 40.0, False, behind)


def _beside_reports(stack: ExitStack, client: Client, task: Task, echo: Bare, payload: bytes) -> Iterator[Figure]:
    """Two clients report without pause; the echo is measured beside two that send the same to another echo."""
    state = workload.states(1)[0]
    other = stack.enter_context(echoing(_RECEIPT))
    report = workload.key("report")
    reporters = [stack.enter_context(_reporter(client.endpoint, report, n)) for n in (1, 2)]
    senders = [stack.enter_context(_reporter(other, KEY, n)) for n in (1, 2)]
    ours, theirs = [], []
    for _ in range(6):
        ours.append(_loaded(reporters, lambda: task.predict(state)))
        theirs.append(_loaded(senders, lambda: echo.ask(payload)))
    reports = sum(load.stop()[0] for load in reporters)
    sent = sum(load.stop()[0] for load in senders)
    a, b = p99(np.concatenate(ours)), p99(np.concatenate(theirs))
    behind = {"predict us": a, "echo us": b, "reports": reports, "echoes of the load": sent}
    yield Figure("predict p99 beside two reporters / echo p99 beside the same", a / b, 2.5, False, behind)
    a, b = p50(np.concatenate(ours)), p50(np.concatenate(theirs))
    yield Figure("  their p50", a / b, None, False, {"predict us": a, "echo us": b})


def _reporter(endpoint: str, key: str, number: int) -> AbstractContextManager[Load]:
    return loading(endpoint, key, "report", 1, number * 10**9)


def _loaded(loads: list[Load], call: Callable[[], Any]) -> Array:
    for load in loads:
        load.go()
    spell(call, 50)
    times = spell(call, 1000)
    for load in loads:
        load.stop()
    return times


def _beside_flood(stack: ExitStack, client: Client, task: Task, echo: Bare, payload: bytes) -> Iterator[Figure]:
    """One client keeps 700 `explain` outstanding, more than the queue holds; the echo is measured beside as many."""
    state = workload.states(1)[0]
    flood = stack.enter_context(loading(client.endpoint, workload.key("explain"), "explain", _FLOOD, 0))
    other = stack.enter_context(loading(stack.enter_context(echoing(_RECEIPT)), KEY, "explain", _FLOOD, 0))
    idle, busy, echo_idle, echo_busy = [], [], [], []
    for _ in range(6):
        idle.append(spell(lambda: task.predict(state), 1000))
        busy.append(_loaded([flood], lambda: task.predict(state)))
        echo_idle.append(spell(lambda: echo.ask(payload), 1000))
        echo_busy.append(_loaded([other], lambda: echo.ask(payload)))
    answered, refused = flood.stop()
    a, b = p99(np.concatenate(busy)), p99(np.concatenate(idle))
    behind = {"beside us": a, "idle us": b, "explained": answered, "refused": refused}
    yield Figure("predict p99 beside 700 explain outstanding / idle", a / b, 3.0, False, behind)
    a, b = p99(np.concatenate(echo_busy)), p99(np.concatenate(echo_idle))
    what = "  echo p99 beside 700 outstanding to another / idle"
    yield Figure(what, a / b, None, False, {"beside us": a, "idle us": b})
