"""A program in the place of many workers: it reports trials at a rate and repeats publications of real ones.

It ends with its standard input, and then prints the published amount as one JSON object.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np
import typer

from crkr.client import Client, Task
from crkr.experiments.bench import workload
from crkr.experiments.bench.processes import say_ready
from crkr.protocol import pack, unpack

__all__: list[str] = []

WORKERS: Final = 8
TICK_S: Final = 0.1
BEFORE: Final = 4500  # trials before the stream, more than a display remembers
BATCH: Final = 500


def _main(endpoint: str, messages: Path, rate: int) -> None:
    contents = [unpack(data) for data in unpack(messages.read_bytes())["messages"]]
    ended = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        ended.set()

    with Client(endpoint) as client:
        task = client.create_task(workload.bench_spec())
        for _ in range(BEFORE // BATCH):
            _report(task, BATCH)
        say_ready()
        threading.Thread(target=wait_for_end, daemon=True).start()
        result = _publish(task, contents, rate, ended)
    sys.stdout.write(json.dumps(result) + "\n")


def _publish(task: Task, contents: list[dict[str, Any]], rate: int, ended: threading.Event) -> dict[str, float]:
    started, count, size = time.monotonic(), 0, 0
    content = cycle(contents)
    while not ended.wait(max(0.0, started + count / rate + TICK_S - time.monotonic())):
        due = int((time.monotonic() - started) * rate) - count
        if due < 1:
            continue
        for seq in _report(task, min(due, BATCH)):
            message = {**next(content), "seq": seq, "worker": f"worker {seq % WORKERS}", "kind": "trial"}
            task.publish("trial", message)
            size += len(pack(message))
            count += 1
    return {"published": count, "bytes": size, "seconds": time.monotonic() - started}


def _report(task: Task, count: int) -> list[int]:
    """Report new trials without success, so that nothing is learned; returns their log positions."""
    states, goals = workload.states(count), np.zeros((count, workload.P))
    return list(task.report(state=states, goal=goals, cost=0.5, success=False, worker="bench").seqs)


if __name__ == "__main__":
    typer.run(_main)
