"""The baseline: a bare Zenoh queryable that answers every query with the same bytes; a process of its own.

It ends when its standard input does, so that it never outlives the bench.
"""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

import typer
import zenoh

__all__ = ["KEY", "main"]

KEY = "bench/echo"


def main(endpoint: str, reply_bytes: int) -> None:
    """Listens on `endpoint` and answers with `reply_bytes` bytes until standard input ends."""
    config = zenoh.Config()
    settings = {
        "mode": "router",
        "listen/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config) as session:
        queries = session.declare_queryable(KEY, zenoh.handlers.FifoChannel(65536), complete=True)
        thread = threading.Thread(target=_answer, args=(queries, bytes(reply_bytes)), daemon=True)
        thread.start()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()
    thread.join(1.0)


def _answer(queries: Any, reply: bytes) -> None:
    while True:
        try:
            query = queries.recv()
        except zenoh.ZError:  # the session is closed
            return
        with query:
            query.payload.to_bytes()
            query.reply(KEY, reply)


if __name__ == "__main__":
    typer.run(main)
