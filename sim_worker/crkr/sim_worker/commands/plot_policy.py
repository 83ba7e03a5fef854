"""`crkr plot policy`: the policy's answers along one coordinate of the state."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crkr.client.cli.console import stderr
from crkr.client.cli.options import Overwrite, TaskName, connected

if TYPE_CHECKING:
    from crkr.client import Client

__all__ = ["policy"]


@connected(5.0)
def policy(
    client: Client,
    task: TaskName,
    vary: Annotated[
        str | None, typer.Option(help="State coordinate to vary, e.g. ball_y; the first unless given.")
    ] = None,
    skill: Annotated[
        str | None,
        typer.Option(help="Skill that draws its goals, as file.py:factory; the task's own unless given."),
    ] = None,
    out: Annotated[Path, typer.Option(dir_okay=False, help="A .png, .svg or .pdf.")] = Path("policy.png"),
    state: Annotated[str | None, typer.Option(help="The other coordinates, in quotes; mid-range unless given.")] = None,
    overwrite: Overwrite = False,
    points: Annotated[int, typer.Option(min=2, max=1000, help="Number of values.")] = 31,
) -> None:
    """Draw what a task's policy answers while one coordinate of the state varies.

    A skill that can shows what the goals mean: where the paddle meets the
    ball, how the ball is thrown. Otherwise each coordinate of the goal is a
    curve. Below: how novel the states are, and the probability of success.

    Example: crkr plot policy table-tennis --vary ball_y --out policy.png
    """
    from crkr.client.cli.options import parse_vector
    from crkr.sim_worker.figure import check_figure
    from crkr.sim_worker.pictures.policy_figure import draw_policy, varied
    from crkr.sim_worker.skill import SkillOptions
    from crkr.sim_worker.skill_registry import load_skill, skill_of

    check_figure(out, overwrite=overwrite)
    asked = client.task(task)
    vary = vary or asked.spec.state[0].name
    index, states = varied(asked.spec, vary, points, None if state is None else parse_vector(state, "--state"))
    answer = asked.predict(states)
    name = skill or skill_of(asked.spec)
    draw_policy(asked.spec, index, answer, None if name is None else load_skill(name, SkillOptions()), out)
    stderr.print(f"{out}: {points} values of {vary}, model version {answer.model_version}")
