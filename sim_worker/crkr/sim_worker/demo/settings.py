"""The settings of a demo, and the extras that it needs installed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final, final

from crkr.protocol import Unsupported

__all__ = ["DemoSettings", "check_extras"]

PACKAGES: Final = {"server": "scipy", "sim": "mujoco", "dashboard": "rerun"}
"""One package of each extra, which shows that the extra is installed."""


@final
@dataclass(frozen=True, slots=True)
class DemoSettings:
    """A demo's settings.

    Attributes:
        skill: Skill to be learned.
        task: Name of the task.
        trials: Total training trials of the task.
        workers: Training processes.
        seed: Of task, demonstrations and workers.
        data: Folder for everything; the server's data directory too, unless it keeps its log in a database.
        database: URL of that database; None: none.
        recording: File that `crkr watch` records to.
        figure: File of the learning curve.
        endpoint: Endpoint of its server.
        dashboard: Whether to run `crkr watch`.
        stay: Keep server and viewer after the run until Enter or Ctrl-C.
    """

    skill: str
    task: str
    trials: int
    workers: int
    seed: int
    data: Path
    database: str | None
    recording: Path
    figure: Path
    endpoint: str
    dashboard: bool
    stay: bool

    @property
    def logs(self) -> Path:
        """Folder of the processes' logs."""
        return self.data / "logs"


def check_extras(dashboard: bool, packages: Mapping[str, str] = PACKAGES) -> None:
    """Raises `Unsupported`, which names every extra that a demo lacks, with or without its dashboard."""
    needed = [extra for extra in packages if dashboard or extra != "dashboard"]
    missing = [extra for extra in needed if find_spec(packages[extra]) is None]
    if missing == ["dashboard"]:
        return  # the demo runs without it, and says so
    if missing:
        extras = ",".join(missing)
        raise Unsupported(f"crkr demo needs the extras {', '.join(missing)}: pip install 'crkr[{extras}]'")
