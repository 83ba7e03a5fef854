"""The baselines: bare Zenoh queryables, each a process of its own.

One answers every query with the same bytes, the other with what no policy server can leave out of its work. They end
when their standard input does, so that they never outlive the bench.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable
from typing import Any

import typer
import zenoh

from crkr.client.bench.arithmetic import bare_prediction

__all__ = ["KEY", "main"]

KEY = "bench/echo"


def main(endpoint: str, reply_bytes: int, samples: int = 0) -> None:
    """Listens on `endpoint` and answers with `reply_bytes` bytes until standard input ends.

    Args:
        endpoint: To listen on.
        reply_bytes: Size of every answer.
        samples: Active samples m of the model that is computed for each answer; 0: none is.
    """
    reply = bytes(reply_bytes)
    compute = bare_prediction(samples, reply) if samples else lambda _: reply
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
        thread = threading.Thread(target=_answer, args=(queries, compute), daemon=True)
        thread.start()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()
    thread.join(1.0)


def _answer(queries: Any, compute: Callable[[bytes], bytes]) -> None:
    while True:
        try:
            query = queries.recv()
        except zenoh.ZError:  # the session is closed
            return
        with query:
            query.reply(KEY, compute(query.payload.to_bytes()))


if __name__ == "__main__":
    typer.run(main)
