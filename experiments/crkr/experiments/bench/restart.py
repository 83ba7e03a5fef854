"""A long log: how soon a server that restarts on it answers, and how quickly from then on."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from crkr.client.bench import workload
from crkr.client.bench.figures import Figure, p50
from crkr.client.bench.processes import serving
from crkr.client.bench.timing import in_turns
from crkr.protocol import Unavailable

__all__ = ["restart_figures"]

_FEW: Final = 1000


def restart_figures(directory: Path, samples: int) -> Iterator[Figure]:
    """Writes logs of `samples` and of 1000 trials, restarts on both and compares.

    The log is written by the server's own store, and the first start finds its radii; the second one is measured.
    """
    few, many = directory / "few", directory / "many"
    for data, count in ((few, _FEW), (many, samples)):
        command = [sys.executable, "-m", "crkr.server.inspection.synthetic_log", str(data), str(count)]
        done = subprocess.run(
            command, check=False, input=json.dumps(workload.bench_spec().to_dict()), text=True, encoding="utf-8"
        )
        if done.returncode:
            raise Unavailable(f"the log of {count} trials was not written: its process ended with {done.returncode}")
        with serving(data):
            pass
    read = min(_bare_read(many) for _ in range(2))
    state = workload.states(1)[0]
    with ExitStack() as stack:
        started = time.perf_counter()
        large = stack.enter_context(serving(many)).task(workload.TASK)
        large.predict(state)
        restart = time.perf_counter() - started
        small = stack.enter_context(serving(few)).task(workload.TASK)
        found = in_turns({"many": lambda: large.predict(state), "few": lambda: small.predict(state)}, 20, 100)
    behind = {"restart s": restart, "bare read s": read}
    yield Figure(f"{samples} samples: restart to first predict / bare read", restart / read, 3.0, False, behind)
    times = {name: p50(taken) for name, taken in found.items()}
    behind = {"many us": times["many"], "few us": times["few"]}
    yield Figure(f"predict p50 at {samples} samples / at {_FEW}", times["many"] / times["few"], 1.1, False, behind)


def _bare_read(data: Path) -> float:
    """Seconds to read every row of the table of trials."""
    with closing(sqlite3.connect(next(data.glob("*.sqlite3")))) as connection:
        started = time.perf_counter()
        for _ in connection.execute("SELECT * FROM trial ORDER BY task, seq"):
            pass
        return time.perf_counter() - started
