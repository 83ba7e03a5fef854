"""One command of the demo, as a process of its own with a log of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import final

__all__ = ["Child"]


@final
class Child:
    """Starts `crkr ARGUMENTS`, tethered to this process.

    Args:
        name: For people, e.g. "server"; also of its log.
        arguments: The command and its options.
        logs: Folder for `name.log` (standard error) and `name.out` (standard output).

    Attributes:
        name: The same.
        log: Where its standard error goes.
    """

    def __init__(self, name: str, arguments: list[str], logs: Path) -> None:
        self.name = name
        self.log = logs / f"{name}.log"
        self._output = logs / f"{name}.out"
        self._read_to = self.log.stat().st_size if self.log.exists() else 0
        self._begun = self._read_to
        self._interrupted = False
        command = [sys.executable, "-m", "crkr.sim_worker.demo.bound_command", *arguments]
        with self.log.open("ab") as errors, self._output.open("wb") as output:
            # A session of its own: the terminal's Ctrl-C reaches the demo only, which ends its children in order.
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=output, stderr=errors, start_new_session=True
            )

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs."""
        return self._process.poll()

    def new_lines(self) -> list[str]:
        """Complete lines of its log since the last call."""
        with self.log.open("rb") as file:
            file.seek(self._read_to)
            data = file.read()
        complete = data[: data.rfind(b"\n") + 1]
        self._read_to += len(complete)
        return complete.decode(errors="replace").splitlines()

    def last_words(self) -> str:
        """Its last error line, else its last line, else that it said nothing."""
        with self.log.open("rb") as file:
            file.seek(self._begun)
            lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
        errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
        return (errors or lines or [f"no message; see {self.log}"])[-1]

    def output(self) -> str:
        """What it has printed to standard output."""
        return self._output.read_text(errors="replace", encoding="utf-8")

    def interrupt(self) -> None:
        """Asks it to end, once: a second signal would end `crkr watch` at once, with half a recording."""
        if not self._interrupted and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            self._interrupted = True

    def end(self, patience_s: float) -> bool:
        """Waits for its end; kills what is left of it after `patience_s` and says False."""
        try:
            self._process.wait(max(0.0, patience_s))
            return True
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return False
        finally:
            self._cut()

    def _cut(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            os.killpg(self._process.pid, signal.SIGKILL)  # what it may have started and left behind
        except ProcessLookupError:
            return
