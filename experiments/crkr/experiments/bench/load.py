"""A client that asks without pause while it is told to; a process of its own.

It reads lines: "go" starts, "stop" ends a spell and is answered by one line: answers, and how many were errors. It ends
when its standard input does.
"""

from __future__ import annotations

import sys
import threading

import typer
import zenoh

from crkr.client.bench.bare import Bare
from crkr.client.bench.workload import explain_payload, report_payload

__all__ = ["main"]


def main(endpoint: str, key: str, kind: str, width: int, seed: int) -> None:
    """Sends `width` queries of `kind` ("report" or "explain") at once, waits for all answers, and again."""
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
            except zenoh.ZError:  # nobody is there to be loaded any more; the next `stop` gets no numbers
                return

    with Bare(endpoint, key) as bare:
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        for line in sys.stdin:
            if line.strip() == "go":
                running.set()
                continue
            running.clear()
            if not thread.is_alive():  # what was measured lately was not loaded: no numbers, and the other end says so
                return
            sys.stdout.write(f"{counts[0]} {counts[1]}\n")
            sys.stdout.flush()
        ended.set()
        running.set()
        thread.join(10.0)


if __name__ == "__main__":
    typer.run(main)
