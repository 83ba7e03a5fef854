"""How far a long command has come: a bar on a terminal, a plain line every few seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from crkr.client.cli.console import stderr

__all__ = ["counting"]

_EVERY_S: Final = 3.0


@contextmanager
def counting(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """Gives what is to be told how many of `total` are done."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=stderr, transient=True, disable=not stderr.is_terminal) as bar:
        shown = bar.add_task(title, total=total)
        said = time.monotonic()

        def show(done: int) -> None:
            nonlocal said
            bar.update(shown, completed=done)
            if not stderr.is_terminal and time.monotonic() - said >= _EVERY_S:
                said = time.monotonic()
                stderr.print(f"{title}: {done} of {total}")

        yield show
