"""`crkr workers`: simulated robots that learn a skill."""

from __future__ import annotations

import signal
import sys
from typing import Annotated

import typer

from crkr.client.cli.console import configure_logging, print_json, stderr
from crkr.client.cli.options import Connect, Json, LogLevel, Timeout, ZenohConfig

__all__ = ["workers"]

Skill = Annotated[
    str, typer.Argument(help="An installed skill, file.py:factory, package.module:factory or gymnasium:ENV-ID.")
]
Workers = Annotated[int, typer.Option("-n", "--workers", min=1, max=4096, help="Training processes.")]
TaskName = Annotated[str | None, typer.Option("--task", help="Name of the task; the skill's own unless given.")]
Trials = Annotated[
    int | None, typer.Option(min=0, help="Training trials in all, after which to stop; no end unless given.")
]
Demonstrations = Annotated[int, typer.Option(min=0, help="Demonstrations to start from, where the skill has any.")]
Evaluations = Annotated[
    int, typer.Option(min=0, max=1024, help="Fixed contexts that judge each epoch of 50 trials; 0 judges none.")
]
Environment = Annotated[str | None, typer.Option(help="Simulator, e.g. contact.")]
LauncherName = Annotated[str | None, typer.Option("--launcher", help="Where contexts come from, e.g. nominal.")]
Preset = Annotated[str | None, typer.Option(help="Specification that the task is created with, e.g. tuned.")]
Seed = Annotated[
    int | None,
    typer.Option(
        min=0, max=2**31 - 1, help="Seed of demonstrations, contexts and a new task; unpredictable unless given."
    ),
]
Patience = Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="How long the server may be away.")]
Stall = Annotated[
    float,
    typer.Option(min=0.1, metavar="SECONDS", help="Kill a worker that makes no progress for this long, and go on."),
]
Wait = Annotated[
    bool,
    typer.Option("--wait", help="Wait until each trial is learned; one worker then repeats a run of its seed."),
]
On = Annotated[str, typer.Option("--on", help="Where workers run: here, or ray, a cluster's nodes.")]
PerPlace = Annotated[
    int, typer.Option("--cpus-per-place", min=1, max=256, help="Workers that one node of a cluster gets at a time.")
]
Fresh = Annotated[
    bool,
    typer.Option("--fresh", help="Delete an existing task and start again, while its specification still changes."),
]


def workers(
    skill: Skill,
    count: Workers = 1,
    task: TaskName = None,
    trials: Trials = None,
    demonstrations: Demonstrations = 5,
    evaluations: Evaluations = 50,
    environment: Environment = None,
    launcher: LauncherName = None,
    preset: Preset = None,
    seed: Seed = None,
    patience: Patience = 60.0,
    stall: Stall = 300.0,
    wait: Wait = False,
    on: On = "here",
    cpus_per_place: PerPlace = 8,
    fresh: Fresh = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    json: Json = False,
    log_level: LogLevel = "warning",
) -> None:
    """Let simulated robots learn a skill.

    Creates the skill's task, or joins it, records the demonstrations it
    lacks, and runs trials in several processes. Ctrl-C ends them all with a
    summary (status 130; 143 for SIGTERM, 129 for SIGHUP); the same command
    resumes the run.

    Example: crkr workers table-tennis -n 4 --trials 1500
    """
    from crkr.client import Client
    from crkr.client.cli.progress import Progress
    from crkr.sim_worker.places.places import load_places
    from crkr.sim_worker.randomness import unpredictable_seed
    from crkr.sim_worker.skill import SkillOptions
    from crkr.sim_worker.supervisor.plan import RunPlan

    configure_logging(log_level)
    for number in (signal.SIGTERM, signal.SIGHUP):  # as process 1 of a container they have no default
        if signal.getsignal(number) is not signal.SIG_IGN:  # by nohup
            signal.signal(number, lambda number, _: sys.exit(128 + number))
    places = load_places(on)
    options = SkillOptions(environment=environment, launcher=launcher, preset=preset, name=task, seed=seed or 0)
    with Client(connect, zenoh_config=zenoh_config) as client:
        endpoint = client.endpoint
    plan = RunPlan(
        skill=skill,
        options=options,
        endpoint=endpoint,
        zenoh_config=zenoh_config,
        workers=count,
        total=trials,
        demonstrations=demonstrations,
        evaluations=evaluations,
        seed=unpredictable_seed() if seed is None else seed,
        timeout_s=timeout,
        patience_s=patience,
        stall_s=stall,
        wait=wait,
        fresh=fresh,
        log_level=log_level,
    )
    with Progress(stderr, "training", trials, "trials") as progress:
        report = places.run(plan, cpus_per_place, progress.say, progress.show)
    stderr.print(report.sentence())
    if json:
        print_json(report.to_dict())
    if report.problem is not None:
        stderr.print(f"error: {report.problem}")
        raise typer.Exit(1)
    if report.stopped_by is not None:
        raise typer.Exit(128 + report.stopped_by)
