"""What a display is told, whichever it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from crkr.dashboard.progress import EpochResult, Progress, Row
from crkr.dashboard.telemetry import Telemetry

__all__ = ["NOT_STORED", "View"]

NOT_STORED: Final = "Replayed from the log, which has no poses, paths, widths or durations: workers only publish them."


class View(Protocol):
    """A display. It is called from one thread and must not wait."""

    def task(self, description: str) -> None:
        """What the task says of itself, "" if nothing; before all else."""
        ...

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        """New trials of the log, in order."""
        ...

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """What a worker published about a trial that was told before."""
        ...

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        """An evaluation is complete."""
        ...

    def status(self, status: Mapping[str, Any], progress: Progress, now: float) -> None:
        """The server's answer to `status`; `now` is monotonic [s]."""
        ...

    def say(self, message: str, *, warning: bool = False) -> None:
        """One line for people."""
        ...

    def tick(self, now: float, progress: Progress) -> None:
        """Time passed; `now` is monotonic [s]."""
        ...
