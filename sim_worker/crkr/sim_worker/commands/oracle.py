"""`crkr oracle`: success of a skill's own planner."""

from __future__ import annotations

from typing import Annotated

import typer

from crkr.client.cli.console import print_json, stderr, stdout
from crkr.client.cli.options import Json
from crkr.sim_worker.commands.evaluate import OldContexts

__all__ = ["oracle"]


def oracle(
    launcher: Annotated[str | None, typer.Option(help="Where contexts come from, e.g. nominal.")] = None,
    contexts: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of contexts.")] = 1000,
    balls: OldContexts = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the contexts, as for crkr evaluate.")] = 0,
    environment: Annotated[str | None, typer.Option(help="Simulator, e.g. contact.")] = None,
    skill: Annotated[
        str, typer.Option(help="A skill with a planner, or your own as file.py:factory.")
    ] = "table-tennis",
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 2,
    json: Json = False,
) -> None:
    """Measure how good a skill's own planner is on fresh contexts.

    A reference for what is possible, not a bound. The contexts are those of
    `crkr evaluate` with the same seed. Needs no server.

    Example: crkr oracle --launcher wide --contexts 200 --seed 7
    """
    from crkr.client.cli.progress import Progress
    from crkr.sim_worker.evaluation.assessment import play_oracle
    from crkr.sim_worker.skill import SkillOptions, options_in_force
    from crkr.sim_worker.skill_registry import load_skill

    contexts = balls or contexts
    options = SkillOptions(environment=environment, launcher=launcher)
    chosen = options_in_force(load_skill(skill, options), options)
    with Progress(stderr, "planning", contexts, "contexts") as progress:
        won = play_oracle(skill, options, contexts, seed, jobs=jobs, show=progress.show)
    result = {
        **won.rates(),
        "ci95": won.intervals(),
        "contexts": contexts,
        "balls": contexts,  # the old name, for one release
        "seed": seed,
        "launcher": chosen.launcher,
        "environment": chosen.environment,
    }
    if json:
        print_json(result)
        return
    stdout.print(", ".join([skill, *filter(None, [chosen.launcher])]) + f": {contexts} contexts, seed {seed}")
    for name, (low, high) in won.intervals().items():
        stdout.print(f"  {name:<10} {won.rate(name):.1%}  (95 %: {low:.1%} to {high:.1%})")
