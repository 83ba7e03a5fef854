"""Child processes of a benchmark: a server, other `crkr` commands, and small programs; all end with the benchmark."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, final

from crkr.client import Client
from crkr.client.cli.error_lines import require
from crkr.protocol import TaskSpec, Unavailable

__all__ = ["Child", "command", "free_endpoint", "program", "running_server", "say_ready", "write_log"]

_START_S: Final = 600.0  # a server reads a long log before it answers
_READY_S: Final = 60.0
_STOP_S: Final = 20.0
_LOOK_S: Final = 0.05
_ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def free_endpoint() -> str:
    """A loopback endpoint that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@final
class Child:
    """A running child process."""

    def __init__(self, name: str, process: subprocess.Popen[str], errors: Path) -> None:
        self._name = name
        self._process = process
        self._errors = errors

    @property
    def end(self) -> Unavailable | None:
        """The end of the process and its last line; None while it runs."""
        status = self._process.poll()
        if status is None:
            return None
        how = f"by signal {-status}" if status < 0 else f"with status {status}"
        lines = [line for line in self._stderr().strip().splitlines() if "listening on" not in line]
        last = f": {lines[-1].removeprefix('error: ')}" if lines else ""
        return Unavailable(f"{self._name} ended {how}{last}")

    def check(self) -> None:
        """Raise `Unavailable` once the process has ended."""
        if self.end is not None:
            raise self.end

    def wait_for(self, sign: str) -> None:
        """Wait until the standard error contains a text.

        Raises:
            Unavailable: The process ended, or did not write it within a minute.
        """
        deadline = time.monotonic() + _READY_S
        while sign not in self._stderr():
            self.check()
            if time.monotonic() > deadline:
                raise Unavailable(f"{self._name} was not ready within {_READY_S:.0f} s")
            time.sleep(_LOOK_S)

    def send(self, line: str) -> None:
        """Write a line to a program; one that has ended is noticed by the next `receive`."""
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.write(line + "\n")
                self._process.stdin.flush()

    def receive(self) -> str:
        """The next line of a program.

        Raises:
            Unavailable: The program ended.
        """
        line = "" if self._process.stdout is None else self._process.stdout.readline()
        if not line:
            self._process.wait(_STOP_S)
            self.check()
        return line.rstrip("\n")

    def finish(self) -> dict[str, Any]:
        """Close the standard input of a program, which ends it, and return the JSON object that it prints.

        Raises:
            Unavailable: It failed.
        """
        output, _ = self._process.communicate(timeout=_STOP_S)
        if self._process.returncode:
            self.check()
        result: dict[str, Any] = json.loads(output)
        return result

    def stop(self) -> None:
        """End the process: close its standard input or send SIGTERM, and kill it if that does not help."""
        if self._process.stdin is None:
            self._process.terminate()
        else:
            with suppress(BrokenPipeError):
                self._process.stdin.close()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _stderr(self) -> str:
        return self._errors.read_text(errors="replace", encoding="utf-8")


@contextmanager
def _child(name: str, arguments: list[str], pipe: int, level: str) -> Iterator[Child]:
    environment = {**os.environ, **_ONE_THREAD, "CRKR_LOG_LEVEL": level}
    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as folder:
        errors = Path(folder) / "stderr"
        with (
            errors.open("wb") as sink,
            subprocess.Popen(
                [sys.executable, "-m", *arguments],
                stdin=pipe if pipe == subprocess.PIPE else None,
                stdout=pipe,
                stderr=sink,
                env=environment,
                text=True,
                encoding="utf-8",
            ) as process,
        ):
            child = Child(name, process, errors)
            try:
                yield child
            finally:
                child.stop()


@contextmanager
def command(arguments: list[str], sign: str = "") -> Iterator[Child]:
    """Run `crkr ARGUMENTS` while the block runs, which begins when its standard error contains `sign`.

    Raises:
        Unavailable: The command ended by itself, or `sign` did not come.
    """
    level = "info" if sign else "warning"
    with _child(f"crkr {arguments[0]}", ["crkr.client", *arguments], subprocess.DEVNULL, level) as child:
        child.wait_for(sign)
        yield child
        child.check()


@contextmanager
def program(module: str, *arguments: str) -> Iterator[Child]:
    """Run `python -m MODULE ARGUMENTS` while the block runs, which begins when the program prints "ready".

    Raises:
        Unavailable: It did not start.
    """
    with _child(module, [module, *arguments], subprocess.PIPE, "warning") as child:
        if child.receive() != "ready":
            raise Unavailable(f"{module} did not start")
        yield child


def say_ready() -> None:
    """Print "ready", the sign that a program runs."""
    sys.stdout.write("ready\n")
    sys.stdout.flush()


@contextmanager
def running_server(data: Path | str) -> Iterator[Client]:
    """A client of a new server on a data directory or a database; the end of the server ends the client's calls.

    Raises:
        Unavailable: The server ended by itself, whatever failed in the block.
    """
    require("scipy")  # the server needs it
    endpoint = free_endpoint()
    with command(["server", "--listen", endpoint, "--data", str(data)]) as server:
        try:
            with Client(endpoint) as client, _closed_with(server, client):
                client.wait_until_ready(_START_S)
                yield client
        except Exception as error:
            if server.end is not None:
                raise server.end from error
            raise


def write_log(data: Path, spec: TaskSpec, count: int) -> None:
    """Have the server's own store write a log of `count` synthetic trials.

    Raises:
        Unavailable: It was not written.
    """
    arguments = [sys.executable, "-m", "crkr.server.inspection.synthetic_log", str(data), str(count)]
    done = subprocess.run(arguments, check=False, input=json.dumps(spec.to_dict()), text=True, encoding="utf-8")
    if done.returncode:
        raise Unavailable(f"the log of {count} trials was not written: its process ended with {done.returncode}")


@contextmanager
def _closed_with(server: Child, client: Client) -> Iterator[None]:
    """Close the client if the server ends: its calls would wait until their deadlines."""
    done = threading.Event()

    def watch() -> None:
        while not done.wait(_LOOK_S):
            if server.end is not None:
                client.close()
                return

    thread = threading.Thread(target=watch, name="server's end", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
