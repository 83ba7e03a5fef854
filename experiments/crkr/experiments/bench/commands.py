"""`crkr bench`: each command measures something beside a bare baseline, in one run, and prints the ratios."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crkr.client.cli.error_lines import require
from crkr.client.cli.options import Json

if TYPE_CHECKING:
    from crkr.experiments.bench.measurements import Measurement

__all__ = ["dashboard", "growth", "learn", "predict", "report", "sim", "tasks"]


def predict(
    samples: Annotated[
        int, typer.Option("--samples", min=0, help="Also restart on a log of this many samples; 1000000 takes minutes.")
    ] = 0,
    as_json: Json = False,
) -> None:
    """Measure predictions beside a bare Zenoh echo of the same bytes.

    Example: crkr bench predict --samples 100000
    """
    require("scipy")
    from crkr.experiments.bench.predict import measure

    _measure_in_folder(lambda folder: measure(folder, samples), "predict, m = 250, d = 6, p = 13, loopback", as_json)


def report(
    database: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Also measure a server on this empty database, postgresql://..., beside it."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure durable reports beside a bare Zenoh echo and a bare SQLite commit of the same row.

    Example: crkr bench report --json
    """
    require("scipy")
    from crkr.experiments.bench.report import measure

    _measure_in_folder(lambda folder: measure(folder, database), "report, d = 6, p = 13, loopback", as_json)


def tasks(
    count: Annotated[int, typer.Option("--tasks", min=20, help="Tasks of the larger server.")] = 2000,
    as_json: Json = False,
) -> None:
    """Measure a new client's first answer, and the creation of a task, beside many other tasks.

    Example: crkr bench tasks --tasks 500
    """
    require("scipy")
    from crkr.experiments.bench.scale import measure_tasks

    _measure_in_folder(
        lambda folder: measure_tasks(folder, count), f"one task of {count}, d = 6, p = 13, loopback", as_json
    )


def learn(
    quick: Annotated[bool, typer.Option("--quick", help="Leave out the million samples, which take minutes.")] = False,
    as_json: Json = False,
) -> None:
    """Measure learning and prediction beside scikit-learn.

    Example: crkr bench learn --quick --json
    """
    require("scipy", "sklearn")
    from crkr.experiments.bench.learn import measure

    _measure_with_progress(measure(quick), "learner, d = 6, p = 13, one BLAS thread", as_json)


def growth(
    part: Annotated[
        list[str] | None,
        typer.Option(
            "--part",
            help="insert, learn, guided, polls, lag, trials, places or ten-million; the first four unless given.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure learning with a million samples, trials or many workers beside few; takes minutes.

    `places` compares workers on a Ray cluster of this machine with those of plain supervisors.

    Example: crkr bench growth --part insert --part guided
    """
    require("scipy", "numba", *(["ray"] if "places" in (part or ()) else []))
    from crkr.experiments.bench.growth import PARTS, measure

    chosen = tuple(part or PARTS[:4])
    if unknown := [one for one in chosen if one not in PARTS]:
        raise typer.BadParameter(f"parts are {', '.join(PARTS)}; got {', '.join(unknown)}", param_hint="--part")
    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as folder:
        _measure_with_progress(measure(Path(folder), chosen), "growth, d = 6, p = 13, one BLAS thread", as_json)


def sim(
    trials: Annotated[int, typer.Option(min=1, max=100_000, help="Trials to time in every environment.")] = 200,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the run that they are taken from.")] = 0,
    skill: Annotated[str, typer.Option(help="table-tennis or throw.")] = "table-tennis",
    as_json: Json = False,
) -> None:
    """Measure trials of a shipped skill: their cost, and how its environments agree.

    Table tennis is compared with bare simulation and with Clarabel, the throw with table tennis. States and goals are
    those of a real run after its first 300 trials. Processor times differ between machines; the ratios should not.

    Example: crkr bench sim --trials 100 --json
    """
    if skill == "table-tennis":
        from crkr.experiments.bench.sim import measure
    elif skill == "throw":
        from crkr.experiments.bench.sim import measure_throw as measure
    else:
        raise typer.BadParameter(f"no skill {skill!r} is measured; choose table-tennis or throw", param_hint="--skill")
    title = f"{skill}, {trials} trials after the first 300 of seed {seed}, one BLAS thread"
    _measure_with_progress(measure(trials, seed), title, as_json)


def dashboard(
    skill: Annotated[str, typer.Option(help="What the workers try.")] = "table-tennis",
    workers: Annotated[int, typer.Option("--workers", "-n", min=1, max=64, help="How many there are.")] = 2,
    as_json: Json = False,
) -> None:
    """Measure the cost of watching: workers' trials, lag, memory, size of a recording; takes a minute.

    Each figure is compared with the same program, following the same task, that draws nothing. No browser is open.

    Example: crkr bench dashboard --json
    """
    require("rerun", "scipy")  # the child processes need them
    from crkr.experiments.bench.dashboard import measure

    _measure_in_folder(lambda folder: measure(folder, skill, workers), "watching, loopback, no browser", as_json)


def _measure_in_folder(measure: Callable[[Path], Iterable[Measurement]], title: str, as_json: bool) -> None:
    """Measure with a temporary folder, then print the table."""
    from crkr.experiments.bench.measurements import show

    with tempfile.TemporaryDirectory(prefix="crkr-bench-") as folder:
        found = list(measure(Path(folder)))
    show(found, title, as_json)


def _measure_with_progress(found: Iterable[Measurement], title: str, as_json: bool) -> None:
    """Print each measurement to standard error when it is done, then the table."""
    from crkr.experiments.bench.measurements import show

    rows = []
    for one in found:
        typer.echo(f"{one.what}: {one.value:.3g}", err=True)
        rows.append(one)
    show(rows, title, as_json, details="detail")
