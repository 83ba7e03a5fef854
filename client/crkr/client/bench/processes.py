"""Processes of a bench: a real server, bare echoes, and clients that load them; all end with the bench."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final, final

from crkr.client.client import Client
from crkr.client.guard import require
from crkr.protocol import Unavailable

__all__ = ["Load", "echoing", "loading", "serving", "start_server", "stop"]

_START_S: Final = 600.0  # a long log takes its time
_STOP_S: Final = 10.0
_ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def start_server(data: Path) -> tuple[subprocess.Popen[bytes], str]:
    """A server process on a free port, and its endpoint; it may not be ready yet."""
    require("scipy")  # or it would die unheard, and the wait for it would be long
    endpoint = _free_endpoint()
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(data)]
    quiet = {**os.environ, **_ONE_THREAD, "CRKR_LOG_LEVEL": "warning"}
    return subprocess.Popen(command, stderr=subprocess.DEVNULL, env=quiet), endpoint


def stop(process: subprocess.Popen[bytes]) -> None:
    """Ends a server in order; one that does not is killed."""
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def serving(data: Path) -> Iterator[Client]:
    """A server that answers, and a client of it."""
    process, endpoint = start_server(data)
    try:
        with Client(endpoint) as client:
            client.wait_until_ready(_START_S)
            yield client
    finally:
        stop(process)


@contextmanager
def echoing(reply_bytes: int) -> Iterator[str]:
    """A bare echo; its endpoint."""
    endpoint = _free_endpoint()
    with _child("crkr.client.bench.echo", endpoint, str(reply_bytes)):
        yield endpoint


@final
class Load:
    """A client that asks without pause between `go` and `stop`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def go(self) -> None:
        """Starts a spell."""
        self._say("go")

    def stop(self) -> tuple[int, int]:
        """Ends it; answers and error replies since the process began."""
        self._say("stop")
        answers, errors = _line(self._process.stdout).split()
        return int(answers), int(errors)

    def _say(self, word: str) -> None:
        if self._process.stdin is not None:
            self._process.stdin.write(word + "\n")
            self._process.stdin.flush()


@contextmanager
def loading(endpoint: str, key: str, kind: str, width: int, seed: int) -> Iterator[Load]:
    """A loading client that waits for its first spell."""
    with _child("crkr.client.bench.load", endpoint, key, kind, str(width), str(seed)) as process:
        yield Load(process)


@contextmanager
def _child(module: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", module, *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **_ONE_THREAD}
    ) as process:
        try:
            if _line(process.stdout) != "ready\n":
                raise Unavailable(f"{module} did not start")
            yield process
        finally:
            if process.stdin is not None:
                process.stdin.close()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _line(stream: IO[str] | None) -> str:
    return "" if stream is None else stream.readline()
