"""`crkr plot policy`: a table tennis policy in Cartesian space."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crkr.client.cli.console import stderr
from crkr.client.cli.options import Connect, Overwrite, Timeout, ZenohConfig

__all__ = ["policy"]


def policy(
    task: Annotated[str, typer.Argument(help="Name of a task of table tennis.")],
    vary: Annotated[str, typer.Option(help="State coordinate to vary, e.g. ball_y.")],
    out: Annotated[Path, typer.Option(dir_okay=False, help="A .png, .svg or .pdf.")] = Path("policy.png"),
    state: Annotated[str | None, typer.Option(help="The other coordinates, in quotes; mid-range unless given.")] = None,
    overwrite: Overwrite = False,
    points: Annotated[int, typer.Option(min=2, max=1000, help="Number of values.")] = 31,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
) -> None:
    """Draw a task's policy in Cartesian space while one coordinate varies.

    Shows where and when the paddle meets the ball, how fast it moves, which
    way it faces, and how novel the state is to the model.

    Example: crkr plot policy table-tennis --vary ball_y --out policy.png
    """
    from crkr.client import Client
    from crkr.client.cli.options import parse_vector
    from crkr.sim_worker.figure import check_figure
    from crkr.sim_worker.table_tennis.pictures.policy_figure import draw_policy, varied

    check_figure(out, overwrite=overwrite)
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        asked = client.task(task)
        index, states = varied(asked.spec, vary, points, None if state is None else parse_vector(state, "--state"))
        answer = asked.predict(states)
    draw_policy(asked.spec, index, states, answer.goals, answer.novelty, out)
    stderr.print(f"{out}: {points} values of {vary}, model version {answer.model_version}")
