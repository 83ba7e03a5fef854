"""`crkr bench sim`: what table tennis trials cost, beside what they cannot do without."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from crkr.client.cli.console import print_json, print_table, stdout
from crkr.client.cli.options import Json

__all__ = ["sim"]


def sim(
    trials: Annotated[int, typer.Option(min=1, max=100_000, help="Trials to time in every environment.")] = 200,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the run that they are taken from.")] = 0,
    json: Json = False,
) -> None:
    """Measure trials of table tennis beside bare simulation, and swings beside Clarabel.

    Balls and goals are those of a real run after its first 300 trials.
    Processor times differ between machines; the ratios should not.

    Example: crkr bench sim --trials 100 --json
    """
    from crkr.experiments.bench.sim_measure import measure

    rows = list(measure(trials, seed))
    if json:
        print_json([{**asdict(row), "reached": row.reached} for row in rows])
        return
    stdout.print(f"table tennis, {trials} trials after the first 300 of seed {seed}, one BLAS thread")
    cells = []
    for row in rows:
        bar = "" if row.bar is None else f"{'≥' if row.at_least else '≤'} {row.bar:.3g}"
        mark = "" if row.bar is None else "reached" if row.reached else "not reached"
        behind = ", ".join(f"{name} {figure:.3g}" for name, figure in row.detail.items())
        cells.append((row.what, f"{row.value:.3g}", bar, mark, behind))
    print_table(("what", "figure", "bar", "", "behind it"), cells)
