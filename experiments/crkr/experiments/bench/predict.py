"""What `crkr bench predict` measures: an answer beside the bare wire, alone, under load, and on a long log."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import repeat
from pathlib import Path
from typing import Any, Final

import numpy as np

from crkr.client import Client, Task
from crkr.experiments.bench import workload
from crkr.experiments.bench.bare_zenoh import KEY, BareQuerier, echo_server
from crkr.experiments.bench.load import Load, running_load
from crkr.experiments.bench.measurements import Measurement, in_turns, p50, p99, ratio, timed
from crkr.experiments.bench.processes import running_server, write_log
from crkr.protocol import Array

__all__ = ["measure", "restart_figures"]

_SAMPLES: Final = 1000
_FEW: Final = 1000
_RECEIPT: Final = 60  # bytes of a report's reply
_FLOOD: Final = 700  # explain requests at once, more than the server's queue holds
_MANY: Final = 20_000  # queries of a throughput
_ROUNDS: Final = 6


def measure(directory: Path, samples: int) -> Iterator[Measurement]:
    """All figures; with `samples` also those of a restart on a log of that length."""
    with ExitStack() as stack:
        client = stack.enter_context(running_server(directory / "data"))
        task = client.create_task(workload.bench_spec())
        workload.fill(task, _SAMPLES)
        payload = workload.predict_payload()
        bare = stack.enter_context(BareQuerier(client.endpoint, workload.key("predict")))
        size = len(bare.ask(payload))
        echo = stack.enter_context(BareQuerier(stack.enter_context(echo_server(size)), KEY))
        least = stack.enter_context(BareQuerier(stack.enter_context(echo_server(size, workload.BUDGET)), KEY))
        yield from _alone(task, bare, echo, least, payload)
        yield _in_flight(bare, echo, payload)
        yield _thousand(task)
        yield from _beside_reports(stack, client, task, echo, payload)
        yield from _beside_flood(stack, client, task, echo, payload)
    if samples:
        yield from restart_figures(directory, samples)


def _alone(
    task: Task, bare: BareQuerier, echo: BareQuerier, least: BareQuerier, payload: bytes
) -> Iterator[Measurement]:
    state = workload.states(1)[0]
    with task.mirror() as mirror:
        calls = {
            "predict": lambda: task.predict(state),
            "wire": lambda: bare.ask(payload),
            "least": lambda: least.ask(payload),
            "echo": lambda: echo.ask(payload),
            "mirror": lambda: mirror.predict(state),
        }
        times = {name: p50(found) for name, found in in_turns(calls, 20, 150).items()}
    yield ratio("Task.predict p50 / echo p50, one in flight", times, "predict", "echo", 1.15)
    yield ratio("  the same bytes asked by bare Zenoh / echo", times, "wire", "echo")
    yield ratio("  the bare arithmetic behind bare Zenoh / echo", times, "least", "echo")
    yield ratio("  Mirror.predict, no network / echo", times, "mirror", "echo")


def _in_flight(bare: BareQuerier, echo: BareQuerier, payload: bytes) -> Measurement:
    queriers = {"predict": bare, "echo": echo}
    rounds = [[one.rate(repeat(payload, _MANY // 4), 64) for one in queriers.values()] for _ in range(4)]
    rates = dict(zip(queriers, np.median(rounds, axis=0).tolist(), strict=True))
    what = "predict rate / echo rate, 64 in flight"
    return ratio(what, rates, "predict", "echo", 0.6, at_least=True, unit="/s")


def _thousand(task: Task) -> Measurement:
    many, one = workload.states(1000), workload.states(1)[0]
    found = in_turns({"1000": lambda: task.predict(many), "1": lambda: task.predict(one)}, 10, 10)
    times = {name: p50(taken) for name, taken in found.items()}
    return ratio("1000 states in one predict / one state", times, "1000", "1", 40.0)


def _beside_reports(
    stack: ExitStack, client: Client, task: Task, echo: BareQuerier, payload: bytes
) -> Iterator[Measurement]:
    """Two clients report without pause; the echo is measured beside two that send the same to another echo."""
    state = workload.states(1)[0]
    other = stack.enter_context(echo_server(_RECEIPT))

    def reporters(endpoint: str, key: str) -> list[Load]:
        return [stack.enter_context(running_load(endpoint, key, "report", 1, n * 10**9)) for n in (1, 2)]

    loads, others = reporters(client.endpoint, workload.key("report")), reporters(other, KEY)
    rounds = [
        (_times_under_load(loads, lambda: task.predict(state)), _times_under_load(others, lambda: echo.ask(payload)))
        for _ in range(_ROUNDS)
    ]
    predict, bare = (np.concatenate(times) for times in zip(*rounds, strict=True))
    behind = {
        "predict us": p99(predict),
        "echo us": p99(bare),
        "reports": sum(load.stop()[0] for load in loads),
        "echoes of the load": sum(load.stop()[0] for load in others),
    }
    what = "predict p99 beside two reporters / echo p99 beside the same"
    yield Measurement(what, behind["predict us"] / behind["echo us"], 2.5, behind=behind)
    yield ratio("  their p50", {"predict": p50(predict), "echo": p50(bare)}, "predict", "echo")


def _beside_flood(
    stack: ExitStack, client: Client, task: Task, echo: BareQuerier, payload: bytes
) -> Iterator[Measurement]:
    """One client keeps 700 `explain` outstanding; the echo is measured beside as many to another echo."""
    state = workload.states(1)[0]
    flood = stack.enter_context(running_load(client.endpoint, workload.key("explain"), "explain", _FLOOD, 0))
    other = stack.enter_context(running_load(stack.enter_context(echo_server(_RECEIPT)), KEY, "explain", _FLOOD, 0))
    rounds = [
        (
            timed(lambda: task.predict(state), 1000),
            _times_under_load([flood], lambda: task.predict(state)),
            timed(lambda: echo.ask(payload), 1000),
            _times_under_load([other], lambda: echo.ask(payload)),
        )
        for _ in range(_ROUNDS)
    ]
    idle, busy, echo_idle, echo_busy = (p99(np.concatenate(times)) for times in zip(*rounds, strict=True))
    answered, refused = flood.stop()
    behind = {"beside us": busy, "idle us": idle, "explained": answered, "refused": refused}
    yield Measurement("predict p99 beside 700 explain outstanding / idle", busy / idle, 3.0, behind=behind)
    what = "  echo p99 beside 700 outstanding to another / idle"
    yield ratio(what, {"beside": echo_busy, "idle": echo_idle}, "beside", "idle")


def _times_under_load(loads: list[Load], call: Callable[[], Any]) -> Array:
    for load in loads:
        load.go()
    timed(call, 50)
    times = timed(call, 1000)
    for load in loads:
        load.stop()
    return times


def restart_figures(directory: Path, samples: int) -> Iterator[Measurement]:
    """Restart on logs of `samples` and of 1000 trials, and compare.

    The server's own store writes the logs. The first start computes their radii; the second one is measured.
    """
    few, many = directory / "few", directory / "many"
    for data, count in ((few, _FEW), (many, samples)):
        write_log(data, workload.bench_spec(), count)
        started = time.perf_counter()
        with running_server(data) as client:
            client.task(workload.TASK).predict(workload.states(1)[0])
            first = time.perf_counter() - started
    read = min(_bare_read(many) for _ in range(2))
    state = workload.states(1)[0]
    what = f"{samples} samples: first restart, which searches for the radii, to first predict / bare read"
    yield ratio(what, {"restart": first, "bare read": read}, "restart", "bare read", 6.0, unit="s")
    with ExitStack() as stack:
        started = time.perf_counter()
        large = stack.enter_context(running_server(many)).task(workload.TASK)
        large.predict(state)
        restart = time.perf_counter() - started
        small = stack.enter_context(running_server(few)).task(workload.TASK)
        found = in_turns({"many": lambda: large.predict(state), "few": lambda: small.predict(state)}, 20, 100)
    what = f"{samples} samples: restart to first predict / bare read"
    yield ratio(what, {"restart": restart, "bare read": read}, "restart", "bare read", 3.0, unit="s")
    times = {name: p50(taken) for name, taken in found.items()}
    yield ratio(f"predict p50 at {samples} samples / at {_FEW}", times, "many", "few", 1.1)


def _bare_read(data: Path) -> float:
    """Seconds to read every row of the table of trials."""
    with closing(sqlite3.connect(next(data.glob("*.sqlite3")))) as connection:
        started = time.perf_counter()
        for _ in connection.execute("SELECT * FROM trial ORDER BY task, seq"):
            pass
        return time.perf_counter() - started
