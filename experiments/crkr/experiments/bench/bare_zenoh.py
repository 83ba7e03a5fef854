"""The baseline: a bare Zenoh querier, and a queryable that answers with as many bytes as the server does.

`python -m crkr.experiments.bench.bare_zenoh ENDPOINT BYTES` runs the queryable until its standard input ends. With
`--samples` it does the minimum of any policy server: decode, compute one prediction, and return the numbers.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Final, Self, final

import numpy as np
import typer
import zenoh

from crkr.client.network.config import Connection
from crkr.experiments.bench.processes import free_endpoint, program, say_ready
from crkr.protocol import Internal, unpack

__all__ = ["KEY", "BareQuerier", "bare_prediction", "echo_server"]

KEY: Final = "bench/echo"
_TIMEOUT_S: Final = 10.0
_CONNECT_S: Final = 5.0


@final
class BareQuerier:
    """One Zenoh session with one querier; a context manager."""

    def __init__(self, endpoint: str, key: str) -> None:
        self._session = zenoh.open(Connection(endpoint).zenoh(_CONNECT_S))
        self._querier = self._session.declare_querier(
            key,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_TIMEOUT_S,
        )

    def send(self, payload: bytes) -> Any:
        """Send a query; returns the channel of its replies."""
        return self._querier.get(zenoh.handlers.FifoChannel(4), payload=payload)

    def ask(self, payload: bytes) -> bytes:
        """The answer to one query."""
        return _answer(self.send(payload).recv())

    def rate(self, payloads: Iterable[bytes], in_flight: int) -> float:
        """Answers a second [1/s] with `in_flight` queries outstanding."""
        waiting: deque[Any] = deque()
        started, count = time.perf_counter(), 0
        for payload in payloads:
            if len(waiting) == in_flight:
                _answer(waiting.popleft().recv())
            waiting.append(self.send(payload))
            count += 1
        while waiting:
            _answer(waiting.popleft().recv())
        return count / (time.perf_counter() - started)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type


def _answer(reply: zenoh.Reply) -> bytes:
    """The bytes of an answer; raises `Internal` for an error reply."""
    if reply.ok is None:
        said = b"" if reply.err is None else reply.err.payload.to_bytes()
        raise Internal(f"a measured query was refused: {said[:200]!r}")
    return reply.ok.payload.to_bytes()


def bare_prediction(samples: int, reply: bytes) -> Callable[[bytes], bytes]:
    """The minimum of a prediction: a kernel row, a product and a triangular solve, d = 6, p = 13, random numbers.

    Args:
        samples: Active samples m.
        reply: As long as the answer, which begins with a mean (13,) and standard deviations (13,).

    Returns:
        A function from a query's payload to the answer.
    """
    from scipy.linalg import blas
    from scipy.spatial.distance import cdist

    rng = np.random.default_rng(0)
    Z, W = rng.normal(size=(samples, 6)), rng.normal(size=(samples, 13))
    L = np.asfortranarray(np.linalg.cholesky(np.exp(-0.5 * cdist(Z, Z, "sqeuclidean")) + np.eye(samples)))

    def compute(payload: bytes) -> bytes:
        z = np.frombuffer(unpack(payload)["states"]["data"])
        k = np.exp(-0.5 * cdist(z[None], Z, "sqeuclidean")[0])
        mean, v = k @ W, blas.dtrsv(L, k, lower=1)
        numbers: bytes = mean.tobytes() + np.sqrt(max(1.0 - v @ v, 0.0) * np.ones(13)).tobytes()
        return numbers + reply[len(numbers) :]

    return compute


@contextmanager
def echo_server(reply_bytes: int, samples: int = 0) -> Iterator[str]:
    """The endpoint of a queryable in another process; with `samples` it computes a prediction for each answer."""
    endpoint = free_endpoint()
    with program("crkr.experiments.bench.bare_zenoh", endpoint, str(reply_bytes), f"--samples={samples}"):
        yield endpoint


def _main(endpoint: str, reply_bytes: int, samples: int = 0) -> None:
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
        thread = threading.Thread(target=_serve, args=(queries, compute), daemon=True)
        thread.start()
        say_ready()
        sys.stdin.read()
    thread.join(1.0)


def _serve(queries: Any, compute: Callable[[bytes], bytes]) -> None:
    while True:
        try:
            query = queries.recv()
        except zenoh.ZError:  # the session is closed
            return
        with query:
            query.reply(KEY, compute(query.payload.to_bytes()))


if __name__ == "__main__":
    typer.run(_main)
