"""A spawned process ends when the process that started it does, however that ended."""

from __future__ import annotations

import multiprocessing
import os
import threading
from multiprocessing.connection import wait
from typing import Final

__all__ = ["ORPHANED", "end_with_parent"]

ORPHANED: Final = 3
"""Exit status of a process whose parent is gone."""


def end_with_parent() -> None:
    """Watches the parent from a thread of its own; does nothing in a process that `multiprocessing` did not start."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(ORPHANED)  # the main thread may be deep in a call; what was reported is stored

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
