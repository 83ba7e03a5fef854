"""`crkr new` and `crkr check-skill`: start and check a skill of your own."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from crkr.client.cli.console import print_json, stdout
from crkr.client.cli.options import Json

__all__ = ["check_skill", "new"]


def new(
    name: Annotated[str, typer.Argument(help="Name of the skill and its files, as my_robot.", show_default=False)],
    folder: Annotated[Path, typer.Option("--in", file_okay=False, help="Folder to write to.")] = Path(),
) -> None:
    """Write a skill of your own, ready to run: a Python file, its specification and a test.

    Example: crkr new my_robot
    """
    from crkr.sim_worker.skill_template import task_name, write_skill

    files = write_skill(name, folder)
    for path in files:
        stdout.print(f"wrote {path}")
    skill = files[0].relative_to(Path.cwd()) if files[0].is_relative_to(Path.cwd()) else files[0]
    task = task_name(files[0].stem)
    stdout.print("then:")
    for command in (
        f"crkr check-skill {skill}:make",
        "crkr server  # in another terminal",
        f"crkr workers {skill}:make -n 2 --trials 300",
        f"crkr evaluate {task}",
        f"crkr page {task} --out report.html",
    ):
        stdout.print(f"  {command}")


def check_skill(
    skill: Annotated[
        str,
        typer.Argument(
            help="An installed skill, file.py:factory, package.module:factory or gymnasium:ENV-ID.", show_default=False
        ),
    ],
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the situations and goals.")] = 0,
    environment: Annotated[str | None, typer.Option(help="Simulator, e.g. contact.")] = None,
    launcher: Annotated[str | None, typer.Option(help="Where contexts come from, e.g. nominal.")] = None,
    timeout: Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="Limit of a trial, +30 s to load.")] = 60.0,
    json: Json = False,
) -> None:
    """Try a skill without a server: shapes, ranges, repeatability, smoothness of outcomes, what an exception does.

    Status 1 if the skill does not keep its contract; warnings do not count.

    Example: crkr check-skill my_robot.py:make
    """
    from crkr.sim_worker.skill import SkillOptions
    from crkr.sim_worker.timed_check import timed_check

    options, remarks = SkillOptions(environment=environment, launcher=launcher), []
    for remark in timed_check(skill, options, seed=seed, timeout_s=timeout):
        remarks.append(remark)
        if not json:
            stdout.print(str(remark))
    if json:
        print_json([asdict(remark) for remark in remarks])
    if any(remark.level == "problem" for remark in remarks):
        raise typer.Exit(1)
