"""What `crkr bench report` measures: a durable report beside a bare echo and a bare SQLite commit of the same row."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from io import FileIO
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np

from crkr.client import Client, Task
from crkr.experiments.bench import workload
from crkr.experiments.bench.bare_zenoh import KEY, BareQuerier, echo_server
from crkr.experiments.bench.measurements import Measurement, in_turns, p50, ratio
from crkr.experiments.bench.processes import running_server

__all__ = ["measure"]

_WARM: Final = 500  # commits, after which the write-ahead log no longer grows: a file that grows is slower to sync


def measure(directory: Path, database: str | None = None) -> Iterator[Measurement]:
    """All figures.

    Args:
        directory: An empty folder, for the files of SQLite's.
        database: URL of an empty PostgreSQL database: a server that keeps its log there is measured too.
    """
    with ExitStack() as stack:
        client = stack.enter_context(running_server(directory / "data"))
        task = client.create_task(workload.bench_spec())
        workload.fill(task, 500)
        bare = stack.enter_context(BareQuerier(client.endpoint, workload.key("report")))
        receipt = bare.ask(workload.report_payload(10**6))
        echo = stack.enter_context(BareQuerier(stack.enter_context(echo_server(len(receipt))), KEY))
        yield from _alone(task, bare, echo, stack.enter_context(closing(_bare_log(directory))))
        yield _in_flight(bare, echo)
        if database is not None:
            synced = stack.enter_context((directory / "synced").open("wb", buffering=0))
            yield from _shared(stack.enter_context(running_server(database)), task, bare, synced)


def _alone(task: Task, bare: BareQuerier, echo: BareQuerier, log: sqlite3.Connection) -> Iterator[Measurement]:
    state, goal = workload.states(1)[0], np.zeros(workload.P)
    numbers = count(2 * 10**6)
    payload = workload.report_payload(10**6)
    calls: dict[str, Callable[[], Any]] = {
        "report": lambda: task.report(state=state, goal=goal, cost=0.5, success=False, worker="bench"),
        "wire": lambda: bare.ask(workload.report_payload(next(numbers))),
        "echo": lambda: echo.ask(payload),
        "commit": _commits(log),
    }
    # One by one: the time of a disk's sync depends on the pause before it, which must be equal for all.
    times = {name: p50(found) for name, found in in_turns(calls, 800, 1).items()}
    floor = times["echo"] + times["commit"]
    behind = {f"{name} us": times[name] for name in ("report", "echo", "commit")}
    yield Measurement("Task.report p50 / (echo + bare commit)", times["report"] / floor, 1.5, behind=behind)
    yield Measurement("  the same by bare Zenoh", times["wire"] / floor, behind={"wire us": times["wire"]})


def _in_flight(bare: BareQuerier, echo: BareQuerier) -> Measurement:
    rates: dict[str, list[float]] = {"report": [], "echo": []}
    numbers = count(3 * 10**6)
    for _ in range(4):
        payloads = [workload.report_payload(next(numbers)) for _ in range(3000)]
        rates["report"].append(bare.rate(payloads, 64))
        rates["echo"].append(echo.rate(payloads, 64))
    medians = {name: float(np.median(found)) for name, found in rates.items()}
    what = "report rate / echo rate, 64 in flight"
    return ratio(what, medians, "report", "echo", 0.1, at_least=True, unit="/s")


def _shared(client: Client, task: Task, bare: BareQuerier, synced: FileIO) -> Iterator[Measurement]:
    """Compares a server with its log in a database, one with a file, and a page synced to the disk, in turns.

    A disk with a limited rate of syncs answers at once or late, so each comes first as often as last.
    """
    shared = client.create_task(workload.bench_spec())
    workload.fill(shared, 500)
    state, goal = workload.states(1)[0], np.zeros(workload.P)
    with BareQuerier(client.endpoint, workload.key("report")) as other:
        calls: dict[str, Callable[[], Any]] = {
            name: lambda one=one: one.report(state=state, goal=goal, cost=0.5, success=False, worker="bench")  # type: ignore[misc]  # the default binds the loop's value
            for name, one in (("PostgreSQL", shared), ("SQLite", task))
        }
        calls["sync"] = lambda: _sync(synced)
        orders = list(calls), list(calls)[::-1]
        turns = [in_turns({name: calls[name] for name in order}, 200, 1) for order in orders * 2]
        times = {f"{name} us": p50(np.concatenate([turn[name] for turn in turns])) for name in calls}
        value = times["PostgreSQL us"] / times["SQLite us"]
        yield Measurement("Task.report p50, PostgreSQL / SQLite", value, 1.5, behind=times)
        rates: dict[str, list[float]] = {"PostgreSQL": [], "SQLite": []}
        numbers = count(4 * 10**6)
        for _ in range(6):
            for name, one in (("PostgreSQL", other), ("SQLite", bare)):
                rates[name].append(one.rate([workload.report_payload(next(numbers)) for _ in range(2000)], 64))
    medians = {name: float(np.median(found)) for name, found in rates.items()}
    what = "reports/s, 64 in flight, PostgreSQL / SQLite"
    yield ratio(what, medians, "PostgreSQL", "SQLite", 0.5, at_least=True, unit="/s")


def _sync(file: FileIO) -> None:
    file.seek(0)
    file.write(bytes(8192))
    os.fdatasync(file.fileno())


def _bare_log(directory: Path) -> sqlite3.Connection:
    """A database beside the server's, with only its table of trials and its settings."""
    with closing(sqlite3.connect(next((directory / "data").glob("*.sqlite3")))) as server:
        tables = server.execute("SELECT sql FROM sqlite_master WHERE tbl_name = 'trial' AND sql IS NOT NULL").fetchall()
        rows = server.execute("SELECT * FROM trial").fetchall()
    bare = sqlite3.connect(directory / "bare.sqlite3", isolation_level=None)
    bare.execute("PRAGMA journal_mode = WAL")
    bare.execute("PRAGMA synchronous = FULL")
    for (statement,) in tables:
        bare.execute(statement)
    bare.executemany(_insert(bare), rows)
    commit = _commits(bare)
    for _ in range(_WARM):
        commit()
    return bare


def _columns(connection: sqlite3.Connection) -> list[str]:
    return [row[1] for row in connection.execute("PRAGMA table_info(trial)")]


def _insert(connection: sqlite3.Connection) -> str:
    columns = _columns(connection)
    return f"INSERT INTO trial ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"


def _commits(log: sqlite3.Connection) -> Callable[[], None]:
    """A call that commits the last row again, under a new log position and id."""
    statement, columns = _insert(log), _columns(log)
    row = list(log.execute("SELECT * FROM trial ORDER BY seq DESC LIMIT 1").fetchone())
    numbers = count(1 + row[columns.index("seq")])

    def commit() -> None:
        number = next(numbers)
        row[columns.index("seq")], row[columns.index("id")] = number, number.to_bytes(16, "big")
        log.execute(statement, row)  # a transaction of its own

    return commit
