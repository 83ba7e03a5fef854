"""What a demo is asked to do, and where it puts things."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

__all__ = ["DemoSettings"]


@final
@dataclass(frozen=True, slots=True)
class DemoSettings:
    """A demo's settings.

    Attributes:
        skill: What is learned.
        task: Under which name.
        trials: Training trials that the task is to hold in all.
        workers: Training processes.
        seed: Of task, demonstrations and workers.
        data: Folder for everything; the server's data directory too.
        recording: File that `crkr watch` records to.
        figure: File of the learning curve.
        endpoint: Where its server listens.
        dashboard: Whether `crkr watch` runs beside.
        stay: Keep server and viewer after the run until Enter or Ctrl-C.
    """

    skill: str
    task: str
    trials: int
    workers: int
    seed: int
    data: Path
    recording: Path
    figure: Path
    endpoint: str
    dashboard: bool
    stay: bool

    @property
    def logs(self) -> Path:
        """Folder of the processes' logs."""
        return self.data / "logs"
