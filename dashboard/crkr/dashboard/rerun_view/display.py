"""The display in Rerun."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final, final

import rerun as rr

from crkr.dashboard.feed import NOT_STORED
from crkr.dashboard.progress import EpochResult, Progress, Row
from crkr.dashboard.rerun_view.blueprint import layout
from crkr.dashboard.rerun_view.curves import Curves
from crkr.dashboard.rerun_view.recording import Recording
from crkr.dashboard.rerun_view.robots import Robots
from crkr.dashboard.rerun_view.text_panels import guide_page, outcomes_page, status_page
from crkr.dashboard.status_facts import server_time
from crkr.dashboard.telemetry import Telemetry
from crkr.protocol import printable

__all__ = ["RerunDisplay"]

_logger = logging.getLogger(__name__)
NUMBERS_EVERY_S: Final = 0.5  # many small chunks slow a viewer down
MOST_NUMBERS: Final = 50_000  # some megabytes
PAGES_EVERY_S: Final = 1.0


@final
class RerunDisplay:
    """A run as a Rerun recording; implements `View`.

    Args:
        recording: Where to.
        task: The task's name.
        replayed: Whether the run is read from its log, without publications.
    """

    def __init__(self, recording: Recording, task: str, *, replayed: bool = False) -> None:
        self._recording = recording
        self._task = task
        self._replayed = replayed
        recording.layout(layout(replayed=replayed))  # first: a viewer with data and no layout invents one
        self._times: dict[str, int] = {"trial": 0, "epoch": 0}
        self._robots = Robots(recording, self._warn)
        self._curves = Curves(recording, self._warn)
        self._status: Mapping[str, Any] = {}
        self._answered = 0.0
        self._next_numbers = self._next_pages = 0.0
        self._pages: dict[str, str] = {}

    def task(self, description: str) -> None:
        """Write the page that explains the panels."""
        page = rr.TextDocument(guide_page(self._task, description), media_type=rr.MediaType.MARKDOWN)
        self._recording.fixed(["guide"], page)

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        """Add points to the curves."""
        self._note_times(progress)
        self._curves.trials(rows)

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """Show a trial in the 3D view."""
        self._robots.picture(row, telemetry)
        self._curves.picture(row, telemetry)

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        """Add a point to the learning curve."""
        self._curves.epoch(result, progress)
        rates = ", ".join(
            f"{name} {result.tally.rate(name):.2f} [{low:.2f}, {high:.2f}]"
            for name, (low, high) in result.tally.intervals().items()
        )
        self.say(f"epoch {result.epoch}: {rates} of {result.balls} evaluation trials")

    def status(self, status: Mapping[str, Any], progress: Progress, now: float) -> None:
        """Keep the status for the next page."""
        self._note_times(progress)
        self._status, self._answered = status, now
        self._curves.status(status, progress)

    def say(self, message: str, *, warning: bool = False) -> None:
        """Add a line to the log panel."""
        level = rr.TextLogLevel.WARN if warning else rr.TextLogLevel.INFO
        self._recording.at(self._times, ["log"], rr.TextLog(printable(message), level=level))

    def _warn(self, message: str) -> None:
        _logger.warning("%s", message)
        self.say(message, warning=True)

    def tick(self, now: float, progress: Progress) -> None:
        """Send what is due."""
        self._robots.tick(now)
        if self._curves.waiting >= MOST_NUMBERS or (now >= self._next_numbers and not self._replayed):
            self._next_numbers = now + NUMBERS_EVERY_S
            self._curves.flush(progress)
        if now >= self._next_pages:
            self._next_pages = now + PAGES_EVERY_S
            self._write_pages(progress, now)

    def finish(self, progress: Progress) -> None:
        """Send all that is left."""
        now = self._answered if self._replayed else time.monotonic()
        self.tick(now, progress)
        self._curves.flush(progress)
        self._write_pages(progress, now)

    def _note_times(self, progress: Progress) -> None:
        self._times = {"trial": progress.trials, "epoch": progress.epoch}

    def _write_pages(self, progress: Progress, now: float) -> None:
        remark = f"*{NOT_STORED}*" if self._replayed else ""
        age = now - self._answered
        clock = now if self._replayed else server_time(self._status, age)  # the clock of a stored run is its times
        pages = {
            "status": status_page(self._task, self._status, age, progress, progress.pace.rate(clock), remark),
            "outcomes": outcomes_page(progress),
        }
        for name, text in pages.items():
            if self._pages.get(name) != text:
                self._pages[name] = text
                page = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
                self._recording.at(self._times, [name], page)
