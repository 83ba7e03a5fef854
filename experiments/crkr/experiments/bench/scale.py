"""Servers at scale: many tasks (`crkr bench tasks`), many supervisors, a long log (`crkr bench growth`)."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import count as numbers_from
from pathlib import Path
from typing import Any, Final

import numpy as np

from crkr.client import Client, Task
from crkr.experiments.bench import workload
from crkr.experiments.bench.bare_zenoh import BareQuerier
from crkr.experiments.bench.measurements import Measurement, in_turns, p50, ratio, timed
from crkr.experiments.bench.processes import command, running_server, write_log
from crkr.protocol import Array, CrkrError, Unavailable

__all__ = ["POLLS", "measure_lag", "measure_places", "measure_polls", "measure_tasks", "measure_trials"]

POLLS: Final = 2000
_ROUNDS: Final = 100  # first answers
_RESTART_S: Final = 20.0
_CROWD: Final = 100  # supervisors
_LONGEST_POLL_S: Final = 2.0  # of a supervisor whose total is far away
_RATE: Final = 1000  # successes a second
_TICK_S: Final = 0.01
_OUTSTANDING: Final = 1000  # reports without an answer yet
_SKILL: Final = "table-tennis"
_WARM: Final = 300  # trials before the counted ones
_COUNTED_S: Final = 15.0
_START_S: Final = 120.0  # of workers; a place of Ray takes ten seconds


def measure_tasks(directory: Path, count: int) -> Iterator[Measurement]:
    """All figures."""
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


def measure_polls(directory: Path, polls: int) -> Iterator[Measurement]:
    """Cost of a look at the count for a server that knows the workers of one supervisor, and of a hundred."""
    with ExitStack() as stack:
        servers: dict[str, tuple[Task, int]] = {}
        for name, workers in (("one", 1), ("hundred", _CROWD)):
            running = stack.enter_context(running_server(directory / name))
            task = running.create_task(workload.bench_spec())
            workload.fill(task, workload.BUDGET)
            for number in range(workers):
                stack.enter_context(task.announce(f"bench-{number}-0"))
            servers[name] = task, _server_process(directory / name)
        costs: dict[str, list[float]] = {name: [] for name in servers}
        for _ in range(5):
            for name, (task, pid) in servers.items():
                before = _cpu_seconds(pid)
                timed(lambda task=task: task.status(brief=True), polls)  # type: ignore[misc]  # its default argument
                costs[name].append((_cpu_seconds(pid) - before) / polls)
    found = {name: 1e6 * min(each) for name, each in costs.items()}
    yield ratio("server's CPU a look at the count: 100 supervisors known / 1", found, "hundred", "one", 1.2)
    share = _CROWD / _LONGEST_POLL_S * found["hundred"] * 1e-6
    yield Measurement("  share of a core that 100 supervisors' looks take", share, 0.05)


def measure_lag(directory: Path, samples: int, offered_s: float = 20.0) -> Iterator[Measurement]:
    """How far learning is behind a thousand successes a second, each a report of its own, on a long log."""
    data = directory / "lag"
    write_log(data, workload.bench_spec(), samples)
    behind: list[int] = []
    with running_server(data) as client, BareQuerier(client.endpoint, workload.key("report")) as bare:
        task, waiting, numbers = client.task(workload.TASK), deque[Any](), numbers_from(10**9)
        started, sent, refused, looked = time.perf_counter(), 0, 0, 0.0
        while (elapsed := time.perf_counter() - started) < offered_s:
            for _ in range(int(elapsed * _RATE) - sent):
                waiting.append(bare.send(workload.report_payload(next(numbers), success=True)))
                sent += 1
                if len(waiting) > _OUTSTANDING:
                    refused += waiting.popleft().recv().ok is None
            if elapsed > looked + 0.5:
                status, looked = task.status(brief=True), elapsed
                behind.append(status["seq"] - status["model_version"])
            time.sleep(_TICK_S)
        refused += sum(reply.recv().ok is None for reply in waiting)
        stored = (sent - refused) / (time.perf_counter() - started)
    found = {
        "stored/s": stored,
        "refused": float(refused),
        "trials, median": float(np.median(behind)),
        "at most": float(max(behind)),
    }
    what = f"{samples} samples, {_RATE} successes a second: model behind the log, in the last quarter [s]"
    late = max(behind[-len(behind) // 4 :])
    yield Measurement(what, late / _RATE, 1.0, behind=found)
    yield Measurement("  successes stored a second / offered", stored / _RATE, 0.95, True)


def measure_trials(
    directory: Path, workers: int = 8, warm: int = _WARM, counted_s: float = _COUNTED_S
) -> Iterator[Measurement]:
    """Cost of a trial of table tennis for the server, after the first `warm` trials."""
    with running_server(directory / "trials") as client, _workers(client, workers):
        task, pid = client.task(_SKILL), _server_process(directory / "trials")
        first, before = _trained(task, warm), _cpu_seconds(pid)
        time.sleep(counted_s)
        trials, spent = max(_trained(task) - first, 1), _cpu_seconds(pid) - before
    behind = {"trials": float(trials), "a second": trials / counted_s}
    what = f"server's CPU a trial of table tennis, {workers} workers [ms]"
    yield Measurement(what, 1e3 * spent / trials, 0.7, behind=behind)


def measure_places(directory: Path, turns: int = 3) -> Iterator[Measurement]:
    """Trials a second of two places on a Ray cluster of this machine, and of two plain supervisors, in turns."""
    import ray

    os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # else Ray writes a token into the home directory
    os.environ.setdefault("RAY_worker_niceness", "0")  # else Ray yields to the supervisors and all other work
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=10**8)
    os.environ["RAY_ADDRESS"] = ray.get_runtime_context().gcs_address
    rates: dict[str, list[float]] = {"Ray": [], "supervisors": []}
    try:
        for turn in range(turns):
            for name, found in rates.items():
                with running_server(directory / f"{name}-{turn}") as client, ExitStack() as stack:
                    if name == "Ray":
                        stack.enter_context(_workers(client, 2, "--on", "ray", "--cpus-per-place", "1"))
                    else:
                        for _ in range(2):
                            stack.enter_context(_workers(client, 1))
                    task = client.task(_SKILL)
                    first, started = _trained(task, _WARM), time.perf_counter()
                    time.sleep(_COUNTED_S)
                    found.append((_trained(task) - first) / (time.perf_counter() - started))
    finally:
        del os.environ["RAY_ADDRESS"]
        ray.shutdown()
    medians = {name: float(np.median(found)) for name, found in rates.items()}
    what = "trials a second: two places on Ray / two supervisors"
    yield ratio(what, medians, "Ray", "supervisors", 0.95, at_least=True, unit="/s")


def _workers(client: Client, count: int, *words: str) -> Any:
    """Workers of table tennis by formulas, without evaluations; a context manager."""
    options = ["-n", str(count), "--environment", "analytic", "--evaluations", "0", "--connect", client.endpoint]
    return command(["workers", _SKILL, *options, *words])


def _trained(task: Task, least: int = 0) -> int:
    """The task's number of training trials, once it has reached `least`."""
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        with suppress(CrkrError):  # not created yet
            samples = task.status(brief=True)["samples"]
            if (trained := int(samples["trial"] + samples["failed"])) >= least:
                return trained
        time.sleep(0.1)
    raise Unavailable(f"no {least} trials within {_START_S:.0f} s")


def _server_process(data: Path) -> int:
    """Process id of the server on a data directory, a child of ours."""
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text(encoding="utf-8").split()
    for pid in map(int, children):
        if str(data).encode() in Path(f"/proc/{pid}/cmdline").read_bytes():
            return pid
    raise RuntimeError(f"no server on {data} was started here")


def _cpu_seconds(pid: int) -> float:
    fields: Any = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
