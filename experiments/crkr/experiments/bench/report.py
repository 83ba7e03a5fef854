"""`crkr bench report`: what a durable acknowledgement costs above the bare wire and a bare commit."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np

from crkr.client.bench import workload
from crkr.client.bench.bare import Bare
from crkr.client.bench.echo import KEY
from crkr.client.bench.figures import Figure, p50, show
from crkr.client.bench.processes import echoing, serving
from crkr.client.bench.timing import in_turns
from crkr.client.cli.options import Json
from crkr.client.task import Task

__all__ = ["report"]

_WARM: Final = 500  # commits, after which the write-ahead log no longer grows: a file that grows is slower to sync


def report(as_json: Json = False) -> None:
    """Measure durable reports beside a bare Zenoh echo and a bare SQLite commit of the same row.

    Example: crkr bench report --json
    """
    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as directory:
        figures = list(_all(Path(directory)))
    show(figures, f"report, d = {workload.D}, p = 13, loopback", as_json)


def _all(directory: Path) -> Iterator[Figure]:
    with ExitStack() as stack:
        client = stack.enter_context(serving(directory / "data"))
        task = client.create_task(workload.bench_spec())
        workload.fill(task, 500)
        bare = stack.enter_context(Bare(client.endpoint, workload.key("report")))
        receipt = bare.ask(workload.report_payload(10**6))
        echo = stack.enter_context(Bare(stack.enter_context(echoing(len(receipt))), KEY))
        yield from _alone(task, bare, echo, stack.enter_context(closing(_bare_log(directory))))
        yield _in_flight(bare, echo)


def _alone(task: Task, bare: Bare, echo: Bare, log: sqlite3.Connection) -> Iterator[Figure]:
    state, goal = workload.states(1)[0], np.zeros(13)
    numbers = count(2 * 10**6)
    payload = workload.report_payload(10**6)
    calls: dict[str, Callable[[], Any]] = {
        "report": lambda: task.report(state=state, goal=goal, cost=0.5, success=False, worker="bench"),
        "wire": lambda: bare.ask(workload.report_payload(next(numbers))),
        "echo": lambda: echo.ask(payload),
        "commit": _committing(log),
    }
    # One by one: how long a disk takes to sync depends on how long it was left alone, and that must be alike for all.
    times = {name: p50(found) for name, found in in_turns(calls, 800, 1).items()}
    floor = times["echo"] + times["commit"]
    behind = {f"{name} us": times[name] for name in ("report", "echo", "commit")}
    yield Figure("Task.report p50 / (echo + bare commit)", times["report"] / floor, 1.5, False, behind)
    yield Figure("  the same by bare Zenoh", times["wire"] / floor, None, False, {"wire us": times["wire"]})


def _in_flight(bare: Bare, echo: Bare) -> Figure:
    rates: dict[str, list[float]] = {"report": [], "echo": []}
    numbers = count(3 * 10**6)
    for _ in range(4):
        payloads = [workload.report_payload(next(numbers)) for _ in range(3000)]
        rates["report"].append(bare.rate(payloads, 64))
        rates["echo"].append(echo.rate(payloads, 64))
    ours, theirs = (float(np.median(rates[name])) for name in ("report", "echo"))
    behind = {"report /s": ours, "echo /s": theirs}
    return Figure("report rate / echo rate, 64 in flight", ours / theirs, 0.1, True, behind)


def _bare_log(directory: Path) -> sqlite3.Connection:
    """A database beside the server's, with its table of trials and its settings, and nothing else."""
    with closing(sqlite3.connect(_database(directory / "data"))) as server:
        tables = server.execute("SELECT sql FROM sqlite_master WHERE tbl_name = 'trial' AND sql IS NOT NULL").fetchall()
        rows = server.execute("SELECT * FROM trial").fetchall()
    bare = sqlite3.connect(directory / "bare.sqlite3", isolation_level=None)
    bare.execute("PRAGMA journal_mode = WAL")
    bare.execute("PRAGMA synchronous = FULL")
    for (statement,) in tables:
        bare.execute(statement)
    bare.executemany(_insert(bare), rows)
    commit = _committing(bare)
    for _ in range(_WARM):
        commit()
    return bare


def _database(data: Path) -> Path:
    return next(data.glob("*.sqlite3"))


def _insert(connection: sqlite3.Connection) -> str:
    columns = [row[1] for row in connection.execute("PRAGMA table_info(trial)")]
    return f"INSERT INTO trial ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"


def _committing(log: sqlite3.Connection) -> Callable[[], None]:
    """Commits the last row again, under a new log position and id."""
    statement = _insert(log)
    names = [row[1] for row in log.execute("PRAGMA table_info(trial)")]
    row = list(log.execute("SELECT * FROM trial ORDER BY seq DESC LIMIT 1").fetchone())
    numbers = count(1 + max(row[0] for row in log.execute("SELECT max(seq) FROM trial")))

    def commit() -> None:
        number = next(numbers)
        row[names.index("seq")], row[names.index("id")] = number, number.to_bytes(16, "big")
        log.execute(statement, row)  # a transaction of its own

    return commit
