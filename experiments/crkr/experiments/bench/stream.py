"""Many workers in one process: reports trials at a rate, and publishes about each what a real worker once did.

It ends when its standard input does, and then says how much it published as one JSON object.
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
from crkr.client.bench import workload
from crkr.protocol import pack, unpack

__all__ = ["main"]

WORKERS: Final = 8
TICK_S: Final = 0.1
BEFORE: Final = 4500  # trials at the start: what a display remembers of the newest trials is then full
BATCH: Final = 500


def main(endpoint: str, messages: Path, rate: int) -> None:
    """Reports `rate` trials a second [1/s], to the task of the other benches, with publications from a file."""
    published = [unpack(data) for data in unpack(messages.read_bytes())["messages"]]
    ended = threading.Event()
    with Client(endpoint) as client:
        task = client.create_task(workload.bench_spec())
        for _ in range(BEFORE // BATCH):
            _report(task, BATCH)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        threading.Thread(target=_wait_for_end, args=(ended,), daemon=True).start()
        said = _publish(task, published, rate, ended)
    sys.stdout.write(json.dumps(said) + "\n")


def _wait_for_end(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


def _publish(task: Task, messages: list[dict[str, Any]], rate: int, ended: threading.Event) -> dict[str, Any]:
    started, count, size = time.monotonic(), 0, 0
    content = cycle(messages)
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


def _report(task: Task, count: int) -> tuple[int, ...]:
    """Log positions of so many new trials, which failed: nothing need be learned from them."""
    receipt = task.report(
        state=workload.states(count), goal=np.zeros((count, 13)), cost=0.5, success=False, worker="bench"
    )
    return tuple(receipt.seqs)


if __name__ == "__main__":
    typer.run(main)
