"""How far a long command has come: a bar on a terminal, a plain line every few seconds elsewhere."""

from __future__ import annotations

import time
from typing import Final, final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.text import Text

from crkr.protocol import printable

__all__ = ["Progress"]

EVERY_S: Final = 3.0


@final
class Progress:
    """A bar or lines, as the console allows; use it with `with`.

    Args:
        console: Where to print.
        title: What is being done.
        total: The count at the end; None if unknown.
        unit: What is counted, e.g. "trials".
        every_s: Time between two plain lines [s].
    """

    def __init__(self, console: Console, title: str, total: int | None, unit: str, every_s: float = EVERY_S) -> None:
        self._console = console
        self._title = title
        self._total = total
        self._unit = f" {unit}" if unit else ""
        self._every_s = every_s
        columns = (
            TextColumn("{task.description}", "bold", markup=False),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
        )
        self._bar = Bar(*columns, TimeElapsedColumn())
        self._task = self._bar.add_task(title, total=total, count=self._count(0))
        self._text = Text(style="dim")
        self._live = Live(console=console, get_renderable=self._render, transient=True)
        self._due = 0.0
        self._last = ""

    def __enter__(self) -> Progress:
        if self._console.is_terminal:
            self._live.start()
        self._due = time.monotonic() + self._every_s
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Removes the bar; a second call does nothing."""
        self._live.stop()

    def show(self, done: int, text: str = "", *, now: bool = False) -> None:
        """Shows that `done` are done, and a remark; `now` prints a plain line even if the last one is recent."""
        self._bar.update(self._task, completed=done, count=self._count(done))
        self._text.plain = printable(text)
        if self._console.is_terminal or not (now or time.monotonic() >= self._due):
            return
        self._due = time.monotonic() + self._every_s
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
            return f"{done}{self._unit}{beyond}"
        return f"{done} of {self._total}{self._unit}"

    def _render(self) -> RenderableType:
        return Group(self._bar.get_renderable(), self._text)
