"""`crkr bench dashboard`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from crkr.client.bench.figures import show
from crkr.client.cli.error_lines import require
from crkr.client.cli.options import Json

__all__ = ["dashboard"]


def dashboard(
    skill: Annotated[str, typer.Option(help="What the workers try.")] = "table-tennis",
    workers: Annotated[int, typer.Option("--workers", "-n", min=1, max=64, help="How many there are.")] = 2,
    as_json: Json = False,
) -> None:
    """Measure what watching costs: workers' trials, lag, memory, size of a recording; takes a minute.

    Beside each figure stands the same program, following the same task, that draws nothing. No browser is open.

    Example: crkr bench dashboard --json
    """
    require("rerun")  # or the processes that are started would die for want of it
    from crkr.dashboard.bench.measure import measure

    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as directory:
        figures = list(measure(Path(directory), skill, workers))
    show(figures, "watching, loopback, no browser", as_json)
