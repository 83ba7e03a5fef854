"""Processes of the bench: workers, a watch, and this folder's own programs; all end with the bench."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, final

from crkr.protocol import Unavailable

__all__ = ["Command", "Program", "commanded", "started"]

_READY_S: Final = 60.0
_END_S: Final = 20.0
_LOOK_S: Final = 0.05
_ENVIRONMENT: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@final
class Program:
    """One of this folder's programs; it is ready, and ends when it is told to or with the bench."""

    def __init__(self, module: str, process: subprocess.Popen[str]) -> None:
        self._module = module
        self._process = process

    def finish(self) -> dict[str, Any]:
        """Ends it, and gives what it measured.

        Raises:
            Unavailable: It ended before it was told to.
        """
        output, _ = self._process.communicate(timeout=_END_S)  # closes its standard input first
        if self._process.returncode != 0:
            raise Unavailable(f"{self._module} ended with status {self._process.returncode}")
        result: dict[str, Any] = json.loads(output)
        return result


@contextmanager
def started(module: str, *arguments: str) -> Iterator[Program]:
    """Runs `python -m module arguments`, which says "ready" and, when its standard input ends, one JSON object."""
    command = [sys.executable, "-m", module, *arguments]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **_ENVIRONMENT},
        encoding="utf-8",
    ) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise Unavailable(f"{module} did not start")
            yield Program(module, process)
        finally:
            process.kill()  # does nothing to one that has ended


@final
class Command:
    """A `crkr` command that runs.

    Args:
        name: Which.
        process: It.
        words: File of its standard error.
    """

    def __init__(self, name: str, process: subprocess.Popen[bytes], words: Path) -> None:
        self._name = name
        self._process = process
        self._words = words

    def check(self) -> None:
        """Raises `Unavailable` with its last words once it has ended."""
        if self._process.poll() is not None:
            raise Unavailable(f"crkr {self._name} ended: {self._last_line()}")

    def wait_for(self, sign: str) -> None:
        """Waits until its standard error has the sign.

        Raises:
            Unavailable: It ended, or does not say so.
        """
        deadline = time.monotonic() + _READY_S
        while sign not in self._words.read_text(errors="replace", encoding="utf-8"):
            self.check()
            if time.monotonic() > deadline:
                raise Unavailable(f"crkr {self._name} was not ready within {_READY_S:.0f} s: {self._last_line()}")
            time.sleep(_LOOK_S)

    def _last_line(self) -> str:
        lines = self._words.read_text(errors="replace", encoding="utf-8").strip().splitlines()
        return lines[-1].removeprefix("error: ") if lines else "it said nothing"


@contextmanager
def commanded(arguments: list[str], sign: str = "") -> Iterator[Command]:
    """Runs `crkr ARGUMENTS` in the block, which begins when its standard error has the sign.

    Raises:
        Unavailable: It ended by itself, or the sign did not come.
    """
    environment = {**os.environ, **_ENVIRONMENT, "CRKR_LOG_LEVEL": "info"}
    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as folder:
        words = Path(folder) / "words"
        with (
            words.open("wb") as errors,
            subprocess.Popen(
                [sys.executable, "-m", "crkr.client", *arguments],
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=environment,
            ) as process,
        ):
            command = Command(arguments[0], process, words)
            try:
                command.wait_for(sign)
                yield command
                command.check()
            finally:
                _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
