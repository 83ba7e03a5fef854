"""Options that several commands share, and the numbers and ids that people type."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any
from uuid import UUID

import typer

from crkr.protocol import GoalDimension, Invalid, StateDimension

__all__ = [
    "Connect",
    "Json",
    "LogLevel",
    "Overwrite",
    "Reason",
    "TaskName",
    "Timeout",
    "ZenohConfig",
    "check_count",
    "connected",
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
TaskName = Annotated[str, typer.Argument(help="Name of the task.")]
Reason = Annotated[str, typer.Option("--reason", help="Reason, kept in the log.")]
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


def connected(timeout_s: float) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command the options of a connection; its first argument is the client that they make.

    Args:
        timeout_s: Deadline of each call unless --timeout is given [s].
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(*, connect: str | None, timeout: float, zenoh_config: Path | None, **arguments: Any) -> None:
            from crkr.client import Client

            with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
                command(client, **arguments)

        lazy = {"Client": Any}  # which some modules import for their types only
        _, *own = inspect.signature(command, eval_str=True, locals=lazy).parameters.values()
        last = [own.pop()] if own and own[-1].annotation is Json else []
        options = {"connect": (Connect, None), "timeout": (Timeout, timeout_s), "zenoh_config": (ZenohConfig, None)}
        of_connection = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
            for name, (annotation, default) in options.items()
        ]
        every = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*own, *of_connection, *last)]
        run.__signature__ = inspect.Signature(every)  # type: ignore[attr-defined]  # what Typer reads
        run.__annotations__ = {each.name: each.annotation for each in every}
        return run

    return decorate


def parse_vector(text: str, option: str) -> list[float]:
    """Parses numbers separated by blanks or commas, "nan" included; a usage error names the option."""
    words = re.split(r"[\s,]+", text.strip())
    try:
        return [float(word) for word in words]
    except ValueError as error:
        example = f'in quotes, as in {option} "0.1 0.2"' if option.startswith("-") else "as 0.1 0.2"
        raise typer.BadParameter(f"{option} takes numbers {example}; got {text!r}") from error


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
            raise typer.BadParameter(f"an id is a UUID, as `crkr trials` lists it; got {text!r}") from error
    return ids
