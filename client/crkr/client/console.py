"""What commands print: results on standard output, all else on standard error, plain lines without a terminal."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from typing import Any, Final
from uuid import UUID

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

__all__ = ["LEVELS", "configure_logging", "json_data", "print_json", "print_table", "stderr", "stdout", "tidy"]

LEVELS: Final = ("debug", "info", "warning", "error")
# Text from users and servers is printed as it is: no markup, no highlighting, no wrapping of plain lines.
stdout: Final = Console(soft_wrap=True, markup=False, highlight=False, emoji=False)
stderr: Final = Console(soft_wrap=True, markup=False, highlight=False, emoji=False, stderr=True)


def json_data(value: Any) -> Any:
    """Plain data for JSON: arrays as lists, ids as text, bytes as hexadecimal, what is not finite as null."""
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
    """A value as people read it: yes and no, 4 significant digits, no brackets."""
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
    stdout.out(json.dumps(json_data(value), allow_nan=False))


def print_table(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str | None = None) -> None:
    """Prints a table; aligned plain lines where nobody watches."""
    cells = [[str(cell) for cell in row] for row in rows]
    if stdout.is_terminal:
        table = Table(*columns, title=title, title_justify="left")
        for row in cells:
            table.add_row(*row)
        stdout.print(table, soft_wrap=False)
        return
    if title:
        stdout.print(title)
    widths = [max(len(row[column]) for row in [list(columns), *cells]) for column in range(len(columns))]
    for row in [list(columns), *cells]:
        stdout.print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def configure_logging(level: str) -> None:
    """Sends log records from `level` on to standard error; for commands that run long.

    Raises:
        typer.BadParameter: No such level.
    """
    if level.lower() not in LEVELS:
        raise typer.BadParameter(f"log level must be one of {', '.join(LEVELS)}; got {level!r}")
    on_terminal = stderr.is_terminal
    handler = RichHandler(console=stderr, show_path=False) if on_terminal else logging.StreamHandler()
    layout = "%(message)s" if on_terminal else "%(asctime)s %(levelname)-7s %(name)s: %(message)s"
    logging.basicConfig(level=level.upper(), handlers=[handler], format=layout, force=True)
