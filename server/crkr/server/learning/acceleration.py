"""Loads the compiled selection once a task is long; short tasks do without.

Compiling takes some ten seconds, once per machine and version. A separate process does it, because the compiler holds
the interpreter's lock; loading from the cache then takes a thread of the server a second.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import time
from typing import Final, final

from crkr.learner import accelerable, accelerate
from crkr.server.installed_code import InstalledCode
from crkr.server.learning.served_task import ServedTask
from crkr.server.thread_faults import started

__all__ = ["LONG", "MUCH_TO_SEARCH", "Acceleration", "accelerate_search"]

logger = logging.getLogger(__name__)

LONG: Final = 10_000  # samples of a task from which on it is faster
MUCH_TO_SEARCH: Final = 200_000  # entries without kept radii, whose computation takes longer than compiling


@final
class Acceleration:
    """Loads the compiled selection in the background, once."""

    def __init__(self) -> None:
        self._begun = False
        self._process: multiprocessing.process.BaseProcess | None = None
        self._stopped = threading.Event()
        self._code = InstalledCode()

    def step(self, task: ServedTask) -> None:
        """Called on a learning thread whenever a task has a new model."""
        if self._begun or task.eligible < LONG:
            return
        self._begun = True
        if not accelerable():
            logger.warning(
                "task %s has %d samples: learning would be quicker with numba, pip install 'crkr[fast]'",
                task.name,
                task.eligible,
            )
            return
        self._begun = started(threading.Thread(target=self._load, name="acceleration", daemon=True))

    def stop(self) -> None:
        """End the process that compiles, if there is one."""
        self._stopped.set()
        if self._process is not None:
            self._process.terminate()

    def _load(self) -> None:
        try:
            started = time.monotonic()
            context = multiprocessing.get_context("spawn")  # a fork would break Zenoh's threads
            process = context.Process(target=_compile, name="compile", daemon=True)
            process.start()
            self._process = process  # only now: one that did not start cannot be terminated
            if self._stopped.is_set():
                process.terminate()
            process.join()
            if self._stopped.is_set():
                return
            if process.exitcode or self._code.is_replaced:
                logger.warning("the selection was not compiled; learning continues without it; a restart tries again")
                return
            accelerate()
            logger.info("the compiled selection is loaded after %.1f s", time.monotonic() - started)
        except Exception:  # learning continues without it
            logger.exception("the compiled selection was not loaded")


def accelerate_search(task: str) -> None:
    """Load the compiled selection now, before radii of a long log are computed; failing only costs time."""
    try:
        if not accelerate():
            logger.warning("restoring task %s would be quicker with numba, pip install 'crkr[fast]'", task)
    except Exception:
        logger.exception("the compiled selection was not loaded")


def _compile() -> None:
    """The process: fill the cache."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends this process
    accelerate()
