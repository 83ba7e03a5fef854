"""Options that several commands share, and the numbers and ids that people type."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated
from uuid import UUID

import typer

from crkr.protocol import GoalDimension, Invalid, StateDimension

__all__ = [
    "Connect",
    "Json",
    "LogLevel",
    "Overwrite",
    "Timeout",
    "ZenohConfig",
    "check_count",
    "parse_ids",
    "parse_vector",
]

Connect = Annotated[
    str | None,
    typer.Option(
        "--connect",
        envvar="CRKR_CONNECT",
        metavar="ENDPOINT",
        help="The server, as a Zenoh endpoint; tcp/127.0.0.1:7447 unless given. Several, by commas, if one stands by.",
        rich_help_panel="Connection",
    ),
]
Timeout = Annotated[
    float,
    typer.Option("--timeout", min=0.01, metavar="SECONDS", help="Deadline of each call.", rich_help_panel="Connection"),
]
ZenohConfig = Annotated[
    Path | None,
    typer.Option(
        "--zenoh-config",
        exists=True,
        dir_okay=False,
        metavar="FILE",
        help="Zenoh configuration (JSON5) with certificates or passwords.",
        rich_help_panel="Connection",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON value for programs.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
LogLevel = Annotated[
    str,
    typer.Option(
        "--log-level",
        envvar="CRKR_LOG_LEVEL",
        metavar="LEVEL",
        help="Log to standard error: debug, info, warning or error.",
    ),
]


def parse_vector(text: str, option: str) -> list[float]:
    """Parses numbers separated by blanks or commas, "nan" included; a usage error names the option."""
    words = re.split(r"[\s,]+", text.strip())
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise typer.BadParameter(f'{option} takes numbers in quotes, as in {option} "0.1 0.2"; got {text!r}') from error


def check_count(numbers: Sequence[float], option: str, axes: Sequence[StateDimension | GoalDimension]) -> None:
    """Raises `Invalid`, with the coordinates' names, unless there is one number for each coordinate."""
    if len(numbers) != len(axes):
        names = ", ".join(axis.name for axis in axes)
        expected = "1 number" if len(axes) == 1 else f"{len(axes)} numbers"
        raise Invalid(f"{option} takes {expected}, ({names}); got {len(numbers)}")


def parse_ids(texts: list[str]) -> list[UUID]:
    """Parses UUIDs; raises a usage error for other text."""
    ids = []
    for text in texts:
        try:
            ids.append(UUID(text))
        except ValueError as error:
            raise typer.BadParameter(f"an id is a UUID, as `crkr explain` prints it; got {text!r}") from error
    return ids
