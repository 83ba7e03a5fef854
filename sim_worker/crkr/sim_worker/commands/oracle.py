"""`crkr oracle`: what a planner that knows the model can reach."""

from __future__ import annotations

from typing import Annotated

import typer

from crkr.client.cli.console import print_json, stderr, stdout
from crkr.client.cli.options import Json

__all__ = ["oracle"]


def oracle(
    launcher: Annotated[str, typer.Option(help="Where contexts come from: nominal, medium or wide.")] = "nominal",
    balls: Annotated[int, typer.Option(min=1, max=1_000_000, help="How many contexts.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the contexts, as of crkr evaluate.")] = 0,
    environment: Annotated[str | None, typer.Option(help="Which simulator, e.g. contact.")] = None,
    skill: Annotated[str, typer.Option(help="Whose planner; or package.module:factory.")] = "table-tennis",
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Processes that plan.")] = 2,
    json: Json = False,
) -> None:
    """Play fresh contexts by the skill's own planner.

    It is the reference for what is possible, not a bound. The contexts are
    those of `crkr evaluate` with the same seed. Needs no server.

    Example: crkr oracle --launcher wide --balls 200 --seed 7
    """
    from crkr.sim_worker.evaluation.oracle import play_oracle
    from crkr.sim_worker.skill import SkillOptions
    from crkr.sim_worker.supervisor.progress import Progress

    options = SkillOptions(environment=environment, launcher=launcher)
    with Progress(stderr, "planning", balls, "contexts") as progress:
        won = play_oracle(skill, options, balls, seed, jobs=jobs, show=progress.show)
    result = {
        **won.rates(),
        "ci95": won.intervals(),
        "balls": balls,
        "seed": seed,
        "launcher": launcher,
        "environment": environment,
    }
    if json:
        print_json(result)
        return
    stdout.print(f"{skill}, launcher {launcher}: {balls} contexts, seed {seed}")
    for name, (low, high) in won.intervals().items():
        stdout.print(f"  {name:<10} {won.rate(name):.1%}  (95 %: {low:.1%} to {high:.1%})")
