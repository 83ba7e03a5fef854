"""`crkr demo`: server, workers and dashboard on one machine."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from crkr.client.cli.console import print_json, stderr, stdout
from crkr.client.cli.options import Json

if TYPE_CHECKING:
    from crkr.sim_worker.demo.summary import DemoResult

__all__ = ["demo"]

LOOPBACK: Final = "127.0.0.1"
FOLDER: Final = "crkr-demo"
DEFAULT_PORT: Final = 7447  # where the other commands look unless told otherwise


def demo(
    trials: Annotated[int, typer.Option(min=0, help="Training trials in all.")] = 1500,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Training processes.")] = 2,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of demonstrations, contexts and exploration.")] = 0,
    dashboard: Annotated[bool, typer.Option(help="Run the live viewer too; needs the extra 'dashboard'.")] = True,
    data: Annotated[
        str,
        typer.Option(metavar="DIR|URL", help="Folder for all files, or postgresql://...; a run there is resumed."),
    ] = FOLDER,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Loopback port of the server; 0 takes any free one.")
    ] = DEFAULT_PORT,
    skill: Annotated[str, typer.Option(help="Skill to learn, or your own as file.py:factory.")] = "table-tennis",
    stay: Annotated[bool, typer.Option("--stay", help="Keep server and viewer until Enter or Ctrl-C.")] = False,
    json: Json = False,
) -> None:
    """Watch a robot learn a skill, table tennis unless another is named, on this machine.

    Starts a server, workers and a dashboard, judges the policy on 50 fixed
    contexts after every 50 trials, and ends with a summary, a learning curve
    and a recording. Ctrl-C ends all processes (status 130); the same command
    resumes the run.

    Example: crkr demo --trials 1500 --seed 3
    Example: crkr demo --skill throw --trials 300
    """
    from crkr.client.cli.progress import Progress
    from crkr.sim_worker.demo.session import run_demo
    from crkr.sim_worker.demo.settings import DemoSettings, check_extras
    from crkr.sim_worker.demo.summary import print_summary, script
    from crkr.sim_worker.skill_registry import check_skill, default_task

    check_extras(dashboard)
    database = data if data.startswith(("postgresql://", "postgres://")) else None
    folder = Path(FOLDER if database else data).resolve()
    settings = DemoSettings(
        skill=check_skill(skill),
        task=default_task(skill),
        trials=trials,
        workers=workers,
        seed=seed,
        data=folder,
        database=database,
        recording=_unused(folder / "run.rrd"),
        figure=_figure(folder),
        endpoint=f"tcp/{LOOPBACK}:{port or _free_port()}",
        dashboard=dashboard,
        stay=stay,
    )
    connect = "" if port == DEFAULT_PORT else f" --connect {settings.endpoint}"
    welcome = (
        f"{workers} workers learn {skill}; server at {settings.endpoint}, everything in {FOLDER if database else data}",
        f"ask it from another terminal: {script('crkr')} status {settings.task}{connect}",
    )

    def finished(result: DemoResult) -> None:
        progress.close()
        if json:
            print_json(result.summary)
        elif result.summary["samples"]:
            print_summary(stdout, result)
        if stay and not result.status:
            stderr.print("server and viewer stay until you press Enter")

    with Progress(stderr, "learning", trials, "trials") as progress:
        result = run_demo(settings, welcome, progress.say, progress.show, finished)
    if result.stopped_by is not None:
        stderr.print(f"stopped by {result.stopped_by}; the same command resumes the run")
    if result.problem is not None:
        stderr.print(f"error: {result.problem}")
    if result.status:
        raise typer.Exit(result.status)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
    return port


def _figure(data: Path) -> Path:
    """File of the learning curve: replaced when a run is resumed; in another folder no existing figure is touched."""
    path = data / "learning-curve.png"
    return path if (data / "logs").is_dir() else _unused(path)


def _unused(path: Path) -> Path:
    """The path, with a number if it exists: existing files are kept."""

    def candidates() -> Iterator[Path]:
        yield path
        yield from (path.with_stem(f"{path.stem}-{number}") for number in count(2))

    return next(candidate for candidate in candidates() if not candidate.exists())
