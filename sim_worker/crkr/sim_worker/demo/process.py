"""One command of the demo as a process with a log, which ends when the demo does.

`python -m crkr.sim_worker.demo.process server ...` runs a command that watches its standard input: a pipe whose other
end only the demo holds, so that it closes even if the demo is killed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Final, final

from crkr.client.cli.main import main

__all__ = ["DemoProcess"]

PATIENCE_S: Final = 4.0
"""Time for a command to end after the demo is gone [s]."""
ORPHANED: Final = 3


@final
class DemoProcess:
    """Starts `crkr ARGUMENTS`, which ends when this process does.

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
        command = [sys.executable, "-m", "crkr.sim_worker.demo.process", *arguments]
        with self.log.open("ab") as errors, self._output.open("wb") as output:
            # A session of its own: the terminal's Ctrl-C reaches only the demo, which ends its processes in order.
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
        """Its last error line, else its last line, else a remark."""
        with self.log.open("rb") as file:
            file.seek(self._begun)
            lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
        errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
        return (errors or lines or [f"no message; see {self.log}"])[-1]

    def output(self) -> str:
        """What it has printed to standard output."""
        return self._output.read_text(errors="replace", encoding="utf-8")

    def interrupt(self) -> None:
        """Sends SIGINT, once: a second one would end `crkr watch` at once, with half a recording."""
        if not self._interrupted and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            self._interrupted = True

    def end(self, patience_s: float) -> bool:
        """Waits for its end; after `patience_s` kills it and returns False."""
        try:
            self._process.wait(max(0.0, patience_s))
            return True
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return False
        finally:
            self._kill_group()

    def _kill_group(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            os.killpg(self._process.pid, signal.SIGKILL)  # processes that it may have left
        except ProcessLookupError:
            return


def _end_with_demo() -> None:
    while os.read(0, 4096):
        continue
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(PATIENCE_S)
    os._exit(ORPHANED)


if __name__ == "__main__":
    threading.Thread(target=_end_with_demo, name="demo-watch", daemon=True).start()
    sys.argv[0] = "crkr"
    main()
