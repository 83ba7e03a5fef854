"""Processes of a bench: a real server, bare echoes, and clients that load them; all end with the bench."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final, final

from crkr.client.cli.error_lines import require
from crkr.client.client import Client
from crkr.protocol import Unavailable

__all__ = ["Load", "echoing", "loading", "serving"]

_START_S: Final = 600.0  # a long log takes its time
_STOP_S: Final = 10.0
_LOOK_S: Final = 0.1  # between looks at whether a server still runs
_ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _start_server(data: Path, words: IO[bytes]) -> tuple[subprocess.Popen[bytes], str]:
    """A server process on a free port, and its endpoint; it may not be ready yet."""
    require("scipy")  # or it would die for want of it
    endpoint = _free_endpoint()
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(data)]
    quiet = {**os.environ, **_ONE_THREAD, "CRKR_LOG_LEVEL": "warning"}
    return subprocess.Popen(command, stderr=words, env=quiet), endpoint


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Ends a server in order; one that does not is killed."""
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def serving(data: Path) -> Iterator[Client]:
    """A server that answers, and a client of it.

    Raises:
        Unavailable: The server ended by itself; whatever failed in the block failed for that.
    """
    with tempfile.TemporaryFile() as words:
        process, endpoint = _start_server(data, words)
        try:
            with Client(endpoint) as client, _ending_with(process, client):
                client.wait_until_ready(_START_S)
                yield client
        except Exception as error:
            if process.poll() is not None:
                raise Unavailable(_last_words(process.returncode, words)) from error
            raise
        finally:
            _stop(process)


@contextmanager
def _ending_with(process: subprocess.Popen[bytes], client: Client) -> Iterator[None]:
    """Inside, the end of the process ends the client's calls, which would wait for an answer until their deadlines."""
    done = threading.Event()

    def watch() -> None:
        while not done.wait(_LOOK_S):
            if process.poll() is not None:
                client.close()
                return

    watching = threading.Thread(target=watch, name="server's end", daemon=True)
    watching.start()
    try:
        yield
    finally:
        done.set()
        watching.join()


def _last_words(status: int, words: IO[bytes]) -> str:
    words.seek(0)
    lines = words.read().decode(errors="replace").strip().splitlines()
    said = [line.removeprefix("error: ") for line in lines if "listening on" not in line]
    how = f"by signal {-status}" if status < 0 else f"with status {status}"
    return f"the server that is measured ended {how}" + (f": {said[-1]}" if said else "")


@contextmanager
def echoing(reply_bytes: int, samples: int = 0) -> Iterator[str]:
    """A bare echo, or with `samples` the bare arithmetic of a model with so many; its endpoint."""
    endpoint = _free_endpoint()
    with _child("crkr.client.bench.echo", endpoint, str(reply_bytes), f"--samples={samples}"):
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
        counts = _line(self._process.stdout).split()
        if len(counts) != 2:
            raise Unavailable("a client that loads the server ended before it was told to")
        return int(counts[0]), int(counts[1])

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
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **_ONE_THREAD},
        encoding="utf-8",
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
