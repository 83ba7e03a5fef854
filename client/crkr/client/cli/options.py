"""Options that are the same in every command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["Connect", "Json", "LogLevel", "Overwrite", "Timeout", "ZenohConfig"]

Connect = Annotated[
    str | None,
    typer.Option(
        "--connect",
        envvar="CRKR_CONNECT",
        metavar="ENDPOINT",
        help="The server, as a Zenoh endpoint; tcp/127.0.0.1:7447 unless given.",
        rich_help_panel="Connection",
    ),
]
Timeout = Annotated[
    float,
    typer.Option("--timeout", min=0.01, metavar="SECONDS", help="Deadline.", rich_help_panel="Connection"),
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
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there already.")]
LogLevel = Annotated[
    str,
    typer.Option(
        "--log-level", envvar="CRKR_LOG_LEVEL", metavar="LEVEL", help="debug, info, warning or error, on stderr."
    ),
]
