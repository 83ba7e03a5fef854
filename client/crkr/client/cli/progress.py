"""How far a long command has come: a bar on a terminal, elsewhere a plain line every few seconds."""

from __future__ import annotations

import time
from typing import Final, final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from crkr.protocol import printable

__all__ = ["ProgressBar"]

_EVERY_S: Final = 3.0


@final
class ProgressBar:
    """Shows progress while its `with` block runs.

    Args:
        console: The console to show it on.
        title: What is being done, e.g. "exporting throw".
        total: The count at the end; None where it is unknown.
        unit: What is counted, e.g. "trials".
    """

    def __init__(self, console: Console, title: str, total: int | None, unit: str) -> None:
        self._console = console
        self._title = title
        self._total = total
        self._unit = unit
        columns = (
            TextColumn("{task.description}", "bold", markup=False),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
        )
        self._bar = Progress(*columns, TimeElapsedColumn())
        self._task = self._bar.add_task(title, total=total, count=self._count(0))
        self._text = Text(style="dim")
        self._live = Live(console=console, get_renderable=self._picture, transient=True)
        self._due = 0.0
        self._last = ""

    def __enter__(self) -> ProgressBar:
        if self._console.is_terminal:
            self._live.start()
        self._due = time.monotonic() + _EVERY_S
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Removes the bar; a second call does nothing."""
        self._live.stop()

    def show(self, done: int, text: str = "", *, now: bool = False) -> None:
        """Shows that `done` are done; with `now`, prints a plain line even if the last one was just printed."""
        self._bar.update(self._task, completed=done, count=self._count(done))
        self._text.plain = printable(text)
        if self._console.is_terminal or not (now or time.monotonic() >= self._due):
            return
        self._due = time.monotonic() + _EVERY_S
        line = f"{self._title}: {self._count(done)}" + (f", {text}" if text else "")
        if line != self._last:
            self.say(line)
        self._last = line

    def say(self, line: str) -> None:
        """Prints a line above the bar."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _count(self, done: int) -> str:
        if self._total is None or done > self._total:
            beyond = "" if self._total is None else f" ({self._total} asked for)"
            return f"{done} {self._unit}{beyond}"
        return f"{done} of {self._total} {self._unit}"

    def _picture(self) -> RenderableType:
        return Group(self._bar.get_renderable(), self._text)
