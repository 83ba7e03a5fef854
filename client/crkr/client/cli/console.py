"""Output of commands: results on standard output, all else on standard error; plain lines without a terminal."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from typing import Any, Final, final
from uuid import UUID

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.logging import RichHandler
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

from crkr.client.cli.standard_streams import READER_GONE, discard_output
from crkr.protocol import LogFormatter, printable

__all__ = ["LEVELS", "configure_logging", "json_data", "print_json", "print_table", "stderr", "stdout", "tidy"]

LEVELS: Final = ("debug", "info", "warning", "error")


@final
class PlainConsole(Console):
    """Prints text from users and servers literally: no markup, no highlighting, no wrapping of plain lines.

    Control characters are shown as escapes. The process ends when the reader of standard output closes it; errors of
    writing to standard error are ignored.
    """

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(soft_wrap=True, markup=False, highlight=False, emoji=False, stderr=stderr)

    def render_str(self, text: str, **options: Any) -> Text:
        """A string as one line with control characters escaped, before its width is measured."""
        return super().render_str(printable(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Escapes control characters in everything else, such as `Text` of a table or a bar."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(printable(segment.text, keep="\n"), segment.style)

    def on_broken_pipe(self) -> None:
        """Called by rich when the reader has closed the stream."""
        self.quiet = True
        if not self.stderr:
            discard_output()
            raise SystemExit(READER_GONE)

    def _check_buffer(self) -> None:
        try:
            super()._check_buffer()
        except OSError as error:
            self._buffer.clear()
            if not self.stderr:
                raise OSError(f"standard output cannot be written: {error.strerror}") from error


stdout: Final = PlainConsole()
stderr: Final = PlainConsole(stderr=True)


def json_data(value: Any) -> Any:
    """Plain data for JSON: arrays as lists, ids as text, bytes as hexadecimal, infinite numbers and NaN as null."""
    if isinstance(value, Mapping):
        return {str(key): json_data(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):  # numpy, without importing it for commands that need none
        return json_data(value.tolist())
    if is_dataclass(value) and not isinstance(value, type):
        return json_data(asdict(value))
    if isinstance(value, list | tuple | set):
        return [json_data(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, bytes):
        return value.hex()
    return str(value) if isinstance(value, UUID) else value


def tidy(value: Any) -> str:
    """A value for people: yes and no, 4 significant digits, no brackets."""
    value = json_data(value)
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return " ".join(tidy(entry) for entry in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def print_json(value: Any) -> None:
    """Prints one JSON value on one line of standard output."""
    stdout.out(json.dumps(json_data(value), allow_nan=False).replace("\x7f", "\\u007f"))  # JSON lets DEL stand


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str | None = None) -> None:
    """Prints a table that wraps cells on a narrow terminal; aligned plain lines without a terminal."""
    columns = [printable(column) for column in columns]
    cells = [[printable(str(cell)) for cell in row] for row in rows]
    if stdout.is_terminal:
        table = Table(*(Column(name, overflow="fold") for name in columns), title=title, title_justify="left")
        for row in cells:
            table.add_row(*row)
        stdout.print(table, soft_wrap=False)
        return
    if title:
        stdout.print(title)
    widths = [max(len(row[column]) for row in [columns, *cells]) for column in range(len(columns))]
    for row in [columns, *cells]:
        stdout.print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def configure_logging(level: str) -> None:
    """Sends log records from `level` on to standard error, for commands that run long.

    Raises:
        typer.BadParameter: No such level.
    """
    if level.lower() not in LEVELS:
        raise typer.BadParameter(f"log level must be one of {', '.join(LEVELS)}; got {level!r}")
    on_terminal = stderr.is_terminal
    handler = RichHandler(console=stderr, show_path=False) if on_terminal else logging.StreamHandler()
    layout = "%(message)s" if on_terminal else "%(asctime)s %(levelname)-7s %(name)s: %(message)s"
    handler.setFormatter(LogFormatter(layout))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
