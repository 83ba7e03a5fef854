"""A stand-in for a server: it speaks Zenoh and msgpack and answers as each test tells it to."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import msgpack
import pytest
import zenoh
from processes import shared_server

CODEC = "application/msgpack"


@dataclass
class Peer:
    """A router session with one queryable. `script` gets the number of the query, from 0, and says what happens.

    It returns a map (an ok reply), an Exception whose argument is a map or bytes (an error reply), bytes (an ok reply
    as it is), a tuple (bytes, encoding), "silence" (no reply) or "hold" (the query stays open).
    """

    endpoint: str
    script: Callable[[int], object]
    queries: list[tuple[str, bytes, str]] = field(default_factory=list)
    held: list[zenoh.Query] = field(default_factory=list)
    heard: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> "Peer":
        config = zenoh.Config()
        for key, value in {
            "mode": "router",
            "listen/endpoints": [self.endpoint],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "scouting/delay": 0,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        queryable = self.session.declare_queryable("crkr/@v1/**", zenoh.handlers.FifoChannel(1000), complete=True)
        self._thread = threading.Thread(target=self._serve, args=(queryable.handler,))
        self._queryable = queryable
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.session.close()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
        self._thread.join()
        self.held.clear()

    def _serve(self, queries: Any) -> None:
        for query in queries:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            number = len(self.queries)
            self.queries.append((str(query.key_expr), payload, str(query.encoding)))
            self._answer(query, self.script(number))
            self.heard.set()

    def _answer(self, query: zenoh.Query, what: object) -> None:
        if what == "hold":
            self.held.append(query)
            return
        with query:
            key = str(query.key_expr)
            if isinstance(what, Exception):
                body = what.args[0]
                query.reply_err(body if isinstance(body, bytes) else msgpack.packb(body), encoding=CODEC)
            elif isinstance(what, tuple):
                query.reply(key, what[0], encoding=what[1])
            elif isinstance(what, bytes):
                query.reply(key, what, encoding=CODEC)
            elif what != "silence":
                query.reply(key, msgpack.packb(what), encoding=CODEC)


@pytest.fixture
def make_peer(free_port: int) -> Iterator[Callable[..., Peer]]:
    """Starts peers, one after the other, at one endpoint: `make_peer(script)` or `make_peer([answer, ..., last])`."""
    with ExitStack() as stack:

        def make(script: Any) -> Peer:
            answers = script
            if not callable(script):

                def answers(number: int) -> object:
                    return script[min(number, len(script) - 1)]

            return stack.enter_context(Peer(f"tcp/127.0.0.1:{free_port}", answers))

        yield make


@pytest.fixture(scope="module")
def shared_endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A real server for all tests of a module; each makes tasks of its own."""
    with shared_server(tmp_path_factory.mktemp("data")) as endpoint:
        yield endpoint
