"""`crkr plot learning` and `crkr plot coverage`: figures of any task's trials."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crkr.client.cli.console import stderr
from crkr.client.cli.options import Overwrite, TaskName, connected

if TYPE_CHECKING:
    from crkr.client import Client, Task
    from crkr.protocol import StoredTrial
    from crkr.sim_worker.pictures.run_figures import Run

__all__ = ["coverage", "learning"]

_Out = Annotated[Path, typer.Option(dir_okay=False, help="A .png, .svg or .pdf.")]


@connected(5.0)
def learning(
    client: Client,
    task: TaskName,
    out: _Out = Path("learning.png"),
    overwrite: Overwrite = False,
) -> None:
    """Draw a task's success and cost over its trials, with 95 % intervals.

    Example: crkr plot learning table-tennis --out learning.png
    """
    from crkr.sim_worker.figure import check_figure
    from crkr.sim_worker.pictures.run_figures import draw_learning

    check_figure(out, overwrite=overwrite)
    run = _read(client.task(task))
    draw_learning(run, out)
    stderr.print(f"{out}: {len(run.met)} training trials, {len(run.history.epochs)} evaluations")


@connected(5.0)
def coverage(
    client: Client,
    task: TaskName,
    out: _Out = Path("coverage.png"),
    overwrite: Overwrite = False,
) -> None:
    """Draw where in the space of states a task has been tried, with what success, and its active samples.

    Example: crkr plot coverage table-tennis --out coverage.png
    """
    from crkr.sim_worker.figure import check_figure
    from crkr.sim_worker.pictures.run_figures import draw_coverage

    check_figure(out, overwrite=overwrite)
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
