"""`crkr plot learning` and `crkr plot coverage`: a task's trials in a figure, whatever the task is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crkr.client.cli.console import stderr
from crkr.client.cli.options import Connect, Overwrite, Timeout, ZenohConfig

if TYPE_CHECKING:
    from crkr.client import Task
    from crkr.protocol import StoredTrial
    from crkr.sim_worker.pictures.run_figures import Run

__all__ = ["coverage", "learning"]

_Name = Annotated[str, typer.Argument(help="Name of the task.")]
_Out = Annotated[Path, typer.Option(dir_okay=False, help="A .png, .svg or .pdf.")]


def learning(
    task: _Name,
    out: _Out = Path("learning.png"),
    overwrite: Overwrite = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
) -> None:
    """Draw a task's success and cost over its trials, with 95 % intervals.

    Example: crkr plot learning table-tennis --out learning.png
    """
    from crkr.client import Client
    from crkr.sim_worker.figure import check_figure
    from crkr.sim_worker.pictures.run_figures import draw_learning

    check_figure(out, overwrite=overwrite)
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        run = _read(client.task(task))
    draw_learning(run, out)
    stderr.print(f"{out}: {len(run.met)} training trials, {len(run.history.epochs)} evaluations")


def coverage(
    task: _Name,
    out: _Out = Path("coverage.png"),
    overwrite: Overwrite = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
) -> None:
    """Draw where in the space of states a task has been tried, with what success, and its active samples.

    Example: crkr plot coverage table-tennis --out coverage.png
    """
    from crkr.client import Client
    from crkr.sim_worker.figure import check_figure
    from crkr.sim_worker.pictures.run_figures import draw_coverage

    check_figure(out, overwrite=overwrite)
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        asked = client.task(task)
        run, active = _read(asked), asked.model()["states"]
    draw_coverage(run, active, out)
    stderr.print(f"{out}: {len(run.states)} training trials, {len(active)} active samples")


def _read(task: Task) -> Run:
    from crkr.client.cli.progress import Progress
    from crkr.sim_worker.pictures.run_figures import Run

    with Progress(stderr, f"reading {task.name}", int(task.status()["seq"]), "log entries") as bar:

        def told() -> Iterator[StoredTrial]:
            for stored in task.iter_samples():
                bar.show(stored.seq)
                yield stored

        return Run(task.spec, told())
