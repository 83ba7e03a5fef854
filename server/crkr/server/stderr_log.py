"""Log lines on standard error, written by a separate thread.

A stopped terminal or an unread pipe would otherwise block any thread that logs, such as the one that commits reports.
"""

from __future__ import annotations

import logging
import queue
import sys
import threading
from typing import Final, final

from crkr.protocol import LogFormatter
from crkr.server.thread_faults import keep_running

__all__ = ["StderrLog"]

_FORMAT: Final = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_MOST: Final = 1000  # waiting lines; further ones are dropped


@final
class StderrLog:
    """Writes all log records from now on."""

    def __init__(self, level: int) -> None:
        self._waiting: queue.Queue[str | threading.Event] = queue.Queue(_MOST)
        self._lost = 0
        handler = _Handler(self)
        handler.setFormatter(LogFormatter(_FORMAT))
        logging.basicConfig(level=level, handlers=[handler])
        threading.Thread(target=keep_running, args=(self._step,), name="log", daemon=True).start()

    def add(self, item: str | threading.Event) -> None:
        """Queue a line, or drop it if the queue is full. An event is set once all lines before it are written."""
        try:
            self._waiting.put_nowait(item)
        except queue.Full:
            self._lost += 1

    def flush(self, patience_s: float = 0.2) -> None:
        """Wait until all lines are written, for `patience_s` at most."""
        written = threading.Event()
        self.add(written)
        written.wait(patience_s)

    def _step(self) -> bool:
        item = self._waiting.get()
        if self._lost:
            lost, self._lost = self._lost, 0
            self._write(f"({lost} lines of the log were not written: nobody read them)")
        if isinstance(item, threading.Event):
            item.set()
        else:
            self._write(item)
        return True

    def _write(self, line: str) -> None:
        try:
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()
        except (OSError, ValueError):  # closed, or nobody reads
            self._lost = 0


@final
class _Handler(logging.Handler):
    def __init__(self, log: StderrLog) -> None:
        super().__init__()
        self._log = log

    def flush(self) -> None:
        self._log.flush()

    def emit(self, record: logging.LogRecord) -> None:
        try:
            line = self.format(record)
        except Exception as error:  # logging must not raise, as with every handler
            line = f"(a line of the log could not be made: {record.name}, line {record.lineno}: {type(error).__name__})"
        self._log.add(line)
