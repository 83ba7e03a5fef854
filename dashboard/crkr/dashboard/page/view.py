"""A run as the sections of a page, static or live."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Final, final

from crkr.dashboard.page import sections, tables
from crkr.dashboard.page.figures import Figures
from crkr.dashboard.page.film import Film
from crkr.dashboard.page.markup import Element, number, tag
from crkr.dashboard.page.played import Extremes
from crkr.dashboard.progress import EpochResult, Progress, Row
from crkr.dashboard.status_facts import server_time
from crkr.dashboard.telemetry import Telemetry
from crkr.protocol import TaskSpec

__all__ = ["PageView"]

LEARNS_S: Final = 20.0  # since the newest trial
LOST_S: Final = 4.0  # since the server answered


@final
class PageView:
    """A run as the sections of a page; implements `View`.

    Attributes:
        figures: The summary of the trials.
        film: The best and the worst of the trials with a motion.
        extremes: The best and the worst trials of the log, for a static page.
    """

    def __init__(self, spec: TaskSpec, progress: Progress, *, live: bool = False) -> None:
        self.figures = Figures(spec, progress)
        self.film, self.extremes = Film(), Extremes()
        self._live = live
        self._answered = time.monotonic()
        self._status: Mapping[str, Any] = {}
        self._description = spec.description

    def task(self, description: str) -> None:
        """Keep the description."""
        self._description = description or self._description

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        """Count trials."""
        del progress  # Unused: the figures have it.
        self.figures.add(rows)
        if not self._live:
            self.extremes.add(rows)

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """Consider a trial for the film."""
        if telemetry.scene is not None:
            self.film.show(telemetry.scene)
        if telemetry.trace is not None and row.kind in ("trial", "evaluation"):
            cost = "" if row.cost is None else f", cost {number(row.cost, 2)}"
            caption = f"trial {number(row.trial)}, {row.reason}{cost}"
            self.film.add(caption, telemetry.success, row.cost, time.monotonic(), telemetry.trace)

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        """Show nothing: the figures have it."""

    def status(self, status: Mapping[str, Any], progress: Progress, now: float) -> None:
        """Keep the server's status."""
        del progress  # Unused.
        self._status, self._answered = status, now

    def say(self, message: str, *, warning: bool = False) -> None:
        """Show nothing: the age of the status tells whether the server answers."""

    def tick(self, now: float, progress: Progress) -> None:
        """Show nothing: a page is made when it is asked for."""

    def resume(self, now: float) -> None:
        """The run is followed again after a pause; `now` is monotonic [s]."""
        self._answered = now

    def parts(self) -> list[Element]:
        """Header and sections, each with an id, in their order."""
        figures, status = self.figures, self._status
        now = server_time(status, time.monotonic() - self._answered)
        made = [
            self._head(now),
            tables.tiles(figures, status, now),
            sections.success(figures),
            sections.reasons(figures),
            sections.regions(figures),
            self.film.section(),
            sections.outcomes(figures),
            sections.costs(figures),
            tables.workers(figures, status, now),
            tables.settings(figures.spec, status),
        ]
        return [part for part in made if part is not None]

    def _head(self, now: float) -> Element:
        return tag(
            "div",
            tag("h1", self.figures.spec.name, self._pill(now)),
            tag("p", self._description, klass="about") if self._description else None,
            sections.summary(self.figures),
            id="head",
        )

    def _pill(self, now: float) -> Element:
        stored, read = self._status.get("seq"), self.figures.progress.seq
        last = self.figures.last
        if not self._live:
            return tag("span", tables.stamp(now), klass="pill")
        if time.monotonic() - self._answered > LOST_S:
            return tag("span", "server does not answer", klass="pill off")
        if isinstance(stored, int) and stored > read + 2000:
            return tag("span", f"reading the log: {100 * read // stored}\u202f%", klass="pill")
        if last is not None and now - last < LEARNS_S:
            return tag("span", "learning", klass="pill on")
        return tag("span", "idle" if last is None else f"idle, last trial {tables.ago(now - last)}", klass="pill")
