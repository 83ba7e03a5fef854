"""How far a long command has come: a bar on a terminal, a plain line every few seconds elsewhere."""

from __future__ import annotations

import time
from typing import Final, final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.text import Text

__all__ = ["Progress"]

EVERY_S: Final = 3.0


@final
class Progress:
    """A bar or lines, as the console allows; use it with `with`.

    Args:
        console: Where to.
        title: What is being done.
        total: When it is finished; None is unknown.
        unit: What is counted, for the plain lines.
    """

    def __init__(self, console: Console, title: str, total: int | None, unit: str) -> None:
        self._console = console
        self._title = title
        self._total = total
        self._unit = unit
        self._bar = Bar(TextColumn("[bold]{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._task = self._bar.add_task(title, total=total)
        self._text = Text(style="dim")
        self._live = Live(console=console, get_renderable=self._picture, transient=True)
        self._due = 0.0
        self._last = ""

    def __enter__(self) -> Progress:
        if self._console.is_terminal:
            self._live.start()
        self._due = time.monotonic() + EVERY_S
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Takes the bar away; a second call does nothing."""
        self._live.stop()

    def show(self, done: int, text: str = "", *, now: bool = False) -> None:
        """Says that `done` are done; `now` prints a plain line even if the last was just printed."""
        self._bar.update(self._task, completed=done)
        self._text.plain = text
        if self._console.is_terminal or not (now or time.monotonic() >= self._due):
            return
        self._due = time.monotonic() + EVERY_S
        of = "" if self._total is None else f" of {self._total}"
        line = f"{self._title}: {done}{of} {self._unit}" + (f", {text}" if text else "")
        if line != self._last:
            self.say(line)
        self._last = line

    def say(self, line: str) -> None:
        """Prints a line of its own above the bar."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _picture(self) -> RenderableType:
        return Group(self._bar.get_renderable(), self._text)
