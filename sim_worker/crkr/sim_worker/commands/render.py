"""`crkr render`: a picture or a film of one trial."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crkr.client.cli.console import stderr
from crkr.client.cli.options import Connect, Overwrite, Timeout, ZenohConfig

if TYPE_CHECKING:
    from crkr.client import Task
    from crkr.sim_worker.skill import Floats, SkillOptions
    from crkr.sim_worker.table_tennis import TableTennis

__all__ = ["render"]


def render(
    out: Annotated[Path, typer.Argument(help="A .png for moments in one picture, a .mp4 or .gif for a film.")],
    launcher: Annotated[str | None, typer.Option(help="Distribution of balls: nominal, medium or wide.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the balls, as for crkr evaluate.")] = 0,
    ball: Annotated[int, typer.Option(min=0, help="Number of the ball.")] = 0,
    environment: Annotated[str | None, typer.Option(help="Simulator, e.g. contact.")] = None,
    task: Annotated[str | None, typer.Option(help="Draw what this task's policy does, instead of the planner.")] = None,
    trial: Annotated[str | None, typer.Option(metavar="UUID", help="Draw this stored trial of --task.")] = None,
    skill: Annotated[str, typer.Option(help="Table tennis, or a variant as package.module:factory.")] = "table-tennis",
    sequence: Annotated[bool, typer.Option("--sequence", help="Show the moments of a .png side by side.")] = False,
    slow: Annotated[
        float, typer.Option(min=1.0, max=100.0, help="Slow motion: a .mp4 or .gif runs this many times slower.")
    ] = 1.0,
    overwrite: Overwrite = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
) -> None:
    """Draw one trial of table tennis, in software where there is no graphics card.

    Without --task the planner plays, and no server is needed. A stored trial
    is simulated again from the ball and the goal in the log, and the result is
    compared with the log.

    Example: crkr render --launcher wide --seed 7 --ball 3 trial.png
    Example: crkr render --trial 2f1c6a1e-6c1f-4b52-9f0e-0d6a3c5b7e11 --slow 4 trial.mp4
    """
    from crkr.client import Client
    from crkr.client.cli.error_lines import require
    from crkr.client.cli.options import parse_ids
    from crkr.client.cli.output_file import check_output
    from crkr.sim_worker.skill import SkillOptions

    if trial is not None and (launcher is not None or seed or ball):
        raise typer.BadParameter("a stored trial has its own ball; leave out --launcher, --seed and --ball")
    wanted = None if trial is None else parse_ids([trial])[0]
    if out.suffix == ".mp4":
        require("av")

    from crkr.sim_worker.pictures.trial_picture import (
        check_kind,
        compared,
        planned,
        render_trial,
        stored_trial,
    )

    check_kind(out, sequence=sequence, slow=slow)
    check_output(out, overwrite=overwrite)
    player = _player(skill, SkillOptions(environment=environment, launcher=launcher))
    if task is None and wanted is None:
        result = render_trial(player, *planned(player, seed, ball), out, sequence=sequence, slow=slow)
        stderr.print(f"{out}: ball {ball} of seed {seed}, {result.info['reason']}")
        return
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        asked = client.task(task or "table-tennis")
        stored = None if wanted is None else stored_trial(asked, wanted)
        state, goal = _asked(asked, player, seed, ball) if stored is None else (stored.state, stored.goal)
    result = render_trial(player, state, goal, out, sequence=sequence, slow=slow)
    if stored is None:
        stderr.print(f"{out}: ball {ball} of seed {seed}, {result.info['reason']}")
        return
    played = f"played again in {player.options.environment} from the stored ball and goal"
    stderr.print(f"{out}: trial {stored.id}, {played}: {compared(stored, result)}")


def _player(name: str, options: SkillOptions) -> TableTennis:
    from crkr.protocol import Invalid
    from crkr.sim_worker.skill_registry import load_skill
    from crkr.sim_worker.table_tennis import TableTennis

    player = load_skill(name, options)
    if not isinstance(player, TableTennis):
        raise Invalid(f"crkr render draws table tennis; skill {name!r} is something else")
    return player


def _asked(task: Task, player: TableTennis, seed: int, ball: int) -> tuple[Floats, Floats]:
    """A state, and the goal of the task's policy there."""
    from crkr.sim_worker.randomness import fresh_rng

    state = player.reset(fresh_rng(seed, ball))
    return state, task.predict(state).goal
