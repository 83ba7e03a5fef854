"""A client in a process of its own that sends queries without pause between "go" and "stop".

It reads these words as lines. "stop" is answered by one line: the numbers of answers and of error replies so far. The
end of its standard input ends it.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import final

import typer
import zenoh

from crkr.experiments.bench.bare_zenoh import BareQuerier
from crkr.experiments.bench.processes import Child, program, say_ready
from crkr.experiments.bench.workload import explain_payload, report_payload

__all__ = ["Load", "running_load"]


@final
class Load:
    """A client that sends queries without pause between `go` and `stop`."""

    def __init__(self, child: Child) -> None:
        self._child = child

    def go(self) -> None:
        """Begin to send."""
        self._child.send("go")

    def stop(self) -> tuple[int, int]:
        """Stop sending; returns the numbers of answers and of error replies since the process began.

        Raises:
            Unavailable: The server stopped answering, so the measurement was without load.
        """
        self._child.send("stop")
        answers, errors = self._child.receive().split()
        return int(answers), int(errors)


@contextmanager
def running_load(endpoint: str, key: str, kind: str, width: int, seed: int) -> Iterator[Load]:
    """A client that sends `width` queries of `kind` ("report" or "explain") at once and waits for all answers."""
    with program("crkr.experiments.bench.load", endpoint, key, kind, str(width), str(seed)) as child:
        yield Load(child)


def _main(endpoint: str, key: str, kind: str, width: int, seed: int) -> None:
    running, ended = threading.Event(), threading.Event()
    counts = [0, 0]

    def work() -> None:
        number = seed
        while not ended.is_set():
            running.wait()
            payloads = []
            for _ in range(width):
                number += 1
                payloads.append(report_payload(number) if kind == "report" else explain_payload())
            try:
                replies = [bare.send(payload) for payload in payloads]
                for reply in replies:
                    counts[reply.recv().ok is None] += 1
            except zenoh.ZError:  # no answer: the next "stop" finds this thread gone
                return

    with BareQuerier(endpoint, key) as bare:
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        say_ready()
        for line in sys.stdin:
            if line.strip() == "go":
                running.set()
                continue
            running.clear()
            if not thread.is_alive():
                sys.stderr.write(f"error: {endpoint} did not answer a query of the load\n")
                raise typer.Exit(1)
            sys.stdout.write(f"{counts[0]} {counts[1]}\n")
            sys.stdout.flush()
        ended.set()
        running.set()
        thread.join(10.0)


if __name__ == "__main__":
    typer.run(_main)
