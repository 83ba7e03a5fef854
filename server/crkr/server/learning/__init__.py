"""Learning from the log: the thread, fits, restarts, and the tasks that are served."""

from __future__ import annotations

__all__: list[str] = []
