"""Checks every row of a long log after a restart, which itself reads only what learning needs.

A trial's seal covers all of its row, such as worker and time. Checking a million seals takes as long as the whole
restart, so a separate process of low priority does it afterwards: `python -m crkr.server.inspection.seal_check`, which
reads `["LOG", {"TASK": POSITION}]` from standard input.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from typing import IO, Final, final

from crkr.protocol import ShuttingDown, StorageError, UnknownTask
from crkr.server.installed_code import InstalledCode
from crkr.server.log import read_log
from crkr.server.thread_faults import run_once

__all__ = ["SealCheck"]

logger = logging.getLogger(__name__)

_DELAY_S: Final = 2.0  # requests that waited for the restart come first
_PRIORITY: Final = 10  # lower than the server's, but not starved on a busy machine


@final
class SealCheck:
    """Checks the rows present at the start, once.

    Args:
        where: The log, as `read_log` takes it.
        tasks: Name -> last log position to check.
        damaged: Called with a task and the damage of its first damaged row.
    """

    def __init__(self, where: str, tasks: Mapping[str, int], damaged: Callable[[str, str], None]) -> None:
        self._where, self._tasks, self._damaged = where, dict(tasks), damaged
        self._stopped, self._starting = threading.Event(), threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._code = InstalledCode()
        self._thread = threading.Thread(target=run_once, args=(self._run,), name="seals", daemon=True)

    def start(self) -> None:
        """Begin, unless there is nothing to check."""
        if self._tasks:
            self._thread.start()

    def stop(self) -> None:
        """Give up, and end the process."""
        self._stopped.set()
        with self._starting:
            if self._process is not None:
                self._process.terminate()
        if self._thread.is_alive():
            self._thread.join(0.5)

    def _run(self) -> None:
        if self._stopped.wait(_DELAY_S):
            return
        if self._code.is_replaced:
            logger.warning("the rows of the task log are not checked: crkr was upgraded or removed; restart it")
            return
        # -P: a file in the working directory must not hide a module of Python's.
        command = [sys.executable, "-P", "-m", "crkr.server.inspection.seal_check"]
        try:
            with self._starting:
                if self._stopped.is_set():
                    return
                # In its own group: Ctrl-C is for the server, which ends this process.
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,  # everyone can read a command line, which would hold the password
                    stdout=subprocess.PIPE,
                    text=True,
                    process_group=0,
                    encoding="utf-8",
                )
                os.setpriority(os.PRIO_PROCESS, self._process.pid, _PRIORITY)
        except OSError as error:
            logger.warning("the rows of the task log are not checked: %s", error.strerror)
            return
        with self._process as process:
            if process.stdin is not None:
                with suppress(BrokenPipeError), process.stdin as asked:
                    asked.write(json.dumps([self._where, self._tasks]))
            if process.stdout is not None:
                self._listen(process.stdout)
        if process.returncode and not self._stopped.is_set():
            logger.warning("the rows of the task log were not checked to the end: status %s", process.returncode)

    def _listen(self, told: IO[str]) -> None:
        for line in told:
            task, damage = json.loads(line)
            if damage:
                logger.error("task %s: %s", task, damage)
                self._damaged(task, damage)
            else:
                logger.info("task %s: every row is intact", task)


def main(where: str, tasks: Mapping[str, int]) -> None:
    """The process: reports the damage of each task, "" without damage."""
    with suppress(BrokenPipeError):  # the server is gone
        for task, upto in tasks.items():
            with suppress(UnknownTask):  # renamed or deleted meanwhile
                sys.stdout.write(json.dumps([task, _damage(where, task, upto)]) + "\n")
                sys.stdout.flush()


def _damage(where: str, task: str, upto: int) -> str:
    try:
        with closing(read_log(where)) as reader:
            reader.check(task, upto)
    except StorageError as error:
        if isinstance(error.__cause__, ShuttingDown):  # the database is away, which says nothing about the rows
            sys.exit(f"task {task}: {error.message}")
        return error.message
    return ""


if __name__ == "__main__":
    main(*json.load(sys.stdin))
