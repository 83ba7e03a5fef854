"""`crkr bench learn`: the command; what it measures is in `bench_learn_measure`, which needs scikit-learn."""

from __future__ import annotations

import json as json_format
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from typing import Annotated, Final, final

import typer
from rich.console import Console
from rich.table import Table

from crkr.client.cli.error_lines import require

__all__ = ["Row", "learn"]

_ONE_THREAD: Final = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@final
@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table.

    Attributes:
        what: What was measured.
        value: The figure.
        bar: What it should reach, or None where there is nothing to reach.
        at_least: The figure should be at least the bar, rather than at most.
        detail: The times behind it [us], or other figures.
    """

    what: str
    value: float
    bar: float | None
    at_least: bool
    detail: dict[str, float]

    @property
    def reached(self) -> bool:
        """Whether the figure reaches its bar."""
        return self.bar is None or (self.value >= self.bar if self.at_least else self.value <= self.bar)


def learn(
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Leave out the million samples, which take minutes.")] = False,
) -> None:
    """Measure learning and prediction beside scikit-learn.

    Example: crkr bench learn --quick --json
    """
    require("scipy", "sklearn")
    command = [sys.executable, "-m", "crkr.experiments.bench.learn_measure", *["--quick"] * quick]
    # A process of its own: the number of BLAS threads is settled when numpy is first imported.
    done = subprocess.run(command, env={**os.environ, **_ONE_THREAD}, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise typer.Exit(1)
    rows = [Row(**entry) for entry in json_format.loads(done.stdout)]
    if json:
        typer.echo(json_format.dumps([{**asdict(row), "reached": row.reached} for row in rows], indent=2))
        return
    table = Table(title="learner, d = 6, p = 13, one BLAS thread")
    for heading in ("what", "figure", "bar", "", "behind it"):
        table.add_column(heading, justify="right" if heading in ("figure", "bar") else "left")
    for row in rows:
        bar = "" if row.bar is None else f"{'≥' if row.at_least else '≤'} {row.bar:.3g}"
        behind = ", ".join(f"{name} {figure:.3g}" for name, figure in row.detail.items())
        mark = "" if row.bar is None else "reached" if row.reached else "[bold red]not reached"
        table.add_row(row.what, f"{row.value:.3g}", bar, mark, behind)
    Console().print(table)
