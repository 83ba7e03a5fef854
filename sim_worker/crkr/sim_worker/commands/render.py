"""`crkr render`: a picture or a film of one trial."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crkr.client.console import stderr
from crkr.client.options import Connect, Timeout, ZenohConfig

__all__ = ["render"]


def render(
    out: Annotated[Path, typer.Argument(help="A .png for moments in one picture, a .mp4 or .gif for a film.")],
    launcher: Annotated[str | None, typer.Option(help="Where the ball comes from: nominal, medium or wide.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the balls, as of crkr evaluate.")] = 0,
    ball: Annotated[int, typer.Option(min=0, help="Which of them.")] = 0,
    environment: Annotated[str | None, typer.Option(help="Which simulator, e.g. contact.")] = None,
    task: Annotated[str | None, typer.Option(help="Draw what this task's policy does, instead of the planner.")] = None,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
) -> None:
    """Draw one trial of table tennis, in software where there is no graphics card.

    Without --task the planner plays, and no server is needed.

    Example: crkr render --launcher wide --seed 7 --ball 3 trial.png
    """
    from crkr.client import Client
    from crkr.sim_worker.randomness import fresh_rng
    from crkr.sim_worker.skill import SkillOptions
    from crkr.sim_worker.table_tennis import make
    from crkr.sim_worker.table_tennis.render_trial import render_trial

    options = SkillOptions(environment=environment, launcher=launcher)
    goal = None
    if task is not None:
        state = make(options).reset(fresh_rng(seed, ball))
        with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
            goal = client.task(task).predict(state).goal
    reason = render_trial(options, seed, out, ball=ball, goal=goal)
    stderr.print(f"{out}: ball {ball} of seed {seed}, {reason}")
