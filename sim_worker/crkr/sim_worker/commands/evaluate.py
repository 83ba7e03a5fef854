"""`crkr evaluate`: how good a task's policy is on fresh contexts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crkr.client.cli.console import print_json, stderr, stdout
from crkr.client.cli.options import Json, TaskName, connected

if TYPE_CHECKING:
    from crkr.client import Client, Task

__all__ = ["OldContexts", "evaluate"]

EARLY = 1000
"""The evaluation before learning is looked for among this many training trials of the log."""


def _renamed(value: int | None) -> int | None:
    if value is not None:
        stderr.print("warning: --balls is now called --contexts")
    return value


OldContexts = Annotated[
    int | None, typer.Option("--balls", min=1, max=1_000_000, hidden=True, callback=_renamed, help="Of --contexts.")
]


@connected(30.0)
def evaluate(
    client: Client,
    task: TaskName,
    skill: Annotated[
        str | None,
        typer.Option(help="Skill that executes the goals, as file.py:factory; the task's own unless given."),
    ] = None,
    contexts: Annotated[int, typer.Option(min=1, max=1_000_000, help="Number of contexts.")] = 1000,
    balls: OldContexts = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the contexts.")] = 0,
    environment: Annotated[str | None, typer.Option(help="Simulator, e.g. contact.")] = None,
    launcher: Annotated[str | None, typer.Option(help="Where contexts come from, e.g. nominal.")] = None,
    record: Annotated[bool, typer.Option("--record", help="Store the trials as evaluations.")] = False,
    oracle: Annotated[bool, typer.Option(help="Compare with the skill's planner, if it has one.")] = True,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 2,
    json: Json = False,
) -> None:
    """Measure how good a task's policy is on fresh contexts, without exploration.

    The contexts are never those of the fixed evaluation set. Prints success
    rates with Wilson's 95 % intervals, those of the skill's own planner, and
    those before learning.

    Example: crkr evaluate table-tennis --contexts 1000 --seed 7
    """
    import numpy as np

    from crkr.client.cli.progress import Progress
    from crkr.sim_worker.evaluation import assessment
    from crkr.sim_worker.guarded_skill import GuardedSkill
    from crkr.sim_worker.skill import SkillOptions, options_in_force
    from crkr.sim_worker.skill_registry import load_skill, skill_of

    contexts = balls or contexts
    options = SkillOptions(environment=environment, launcher=launcher, name=task)
    judged = client.task(task)
    name = skill or skill_of(judged.spec) or task
    player = load_skill(name, options)
    chosen = options_in_force(player, options)
    answers = assessment.ask(judged, GuardedSkill(player), contexts, seed)
    goals = np.concatenate([answer.goals for answer in answers])
    with Progress(stderr, "evaluating", contexts, "contexts") as progress:
        played = assessment.play(
            name, options, goals, seed, jobs=min(jobs, contexts), oracle=oracle, show=progress.show
        )
    score = assessment.Assessment()
    for one in played:
        score.add(one)
    source = f"{chosen.environment or 'default'}/{chosen.launcher or 'default'}"
    stored = assessment.record(judged, answers, played, seed, source) if record else 0
    result = {
        "task": task,
        **score.to_dict(),
        "contexts": contexts,
        "balls": contexts,  # the old name, for one release
        "seed": seed,
        "environment": chosen.environment,
        "launcher": chosen.launcher,
        "before_learning": _before(judged),
        "model_version": answers[0].model_version,
        "active": answers[0].active,
        "recorded": stored,
    }
    if json:
        print_json(result)
    else:
        _print(result, score.policy.criteria)


def _before(task: Task) -> dict[str, Any] | None:
    """Success on the fixed contexts at epoch 0, if the log has it near its start."""
    from crkr.sim_worker.evaluation.run_history import RunHistory

    history = RunHistory(task.spec)
    for stored in task.iter_samples():
        history.add(stored)
        if history.trained > EARLY:
            break
    first = next((score for score in history.epochs if score.epoch == 0), None)
    return None if first is None else {**first.tally.rates(), "contexts": first.contexts, "balls": first.contexts}


def _print(result: dict[str, Any], names: Sequence[str]) -> None:
    stdout.print(f"{result['task']}: {result['contexts']} fresh contexts, seed {result['seed']}")
    before, planner = result["before_learning"] or {}, result["oracle"] or {}
    for name in names:
        low, high = result["ci95"][name]
        line = f"  {name:<10} {result[name]:.1%}  (95 %: {low:.1%} to {high:.1%})"
        line += f", planner {planner[name]:.1%}" if name in planner else ""
        line += f", before learning {before[name]:.0%} of {before['contexts']} fixed contexts" if name in before else ""
        stdout.print(line)
    reasons = ", ".join(f"{reason} {number}" for reason, number in result["reasons"].items())
    stdout.print(f"  reasons    {reasons}")
    if result["recorded"]:
        stdout.print(f"  recorded   {result['recorded']} evaluations")
