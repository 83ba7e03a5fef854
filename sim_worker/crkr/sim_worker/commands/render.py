"""`crkr render`: a picture or a film of one trial."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crkr.client.cli.console import stderr
from crkr.client.cli.options import Connect, Overwrite, Timeout, ZenohConfig
from crkr.protocol import Array

if TYPE_CHECKING:
    from uuid import UUID

    from crkr.client import Task
    from crkr.protocol import Trial
    from crkr.sim_worker.skill import Skill

__all__ = ["render"]

DEFAULT = "table-tennis"


def render(
    out: Annotated[Path, typer.Argument(help="A .png for moments in one picture, a .mp4 or .gif for a film.")],
    launcher: Annotated[str | None, typer.Option(help="Where contexts come from, e.g. nominal.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the contexts, as for crkr evaluate.")] = 0,
    context: Annotated[int, typer.Option("--context", "--ball", min=0, help="Number of the context.")] = 0,
    environment: Annotated[str | None, typer.Option(help="Simulator, e.g. contact.")] = None,
    task: Annotated[str | None, typer.Option(help="Draw what this task's policy does, instead of the planner.")] = None,
    trial: Annotated[str | None, typer.Option(metavar="UUID", help="Draw this stored trial of --task.")] = None,
    skill: Annotated[
        str | None,
        typer.Option(help="Skill that executes, as file.py:factory; --task's own, else table-tennis."),
    ] = None,
    sequence: Annotated[bool, typer.Option("--sequence", help="Show the moments of a .png side by side.")] = False,
    slow: Annotated[
        float, typer.Option(min=1.0, max=100.0, help="Slow motion: a .mp4 or .gif runs this many times slower.")
    ] = 1.0,
    overwrite: Overwrite = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
) -> None:
    """Draw one trial of a skill, in software where there is no graphics card.

    Without --task the skill's planner plays, and no server is needed. A stored
    trial is executed again from the state and the goal in the log, and the
    result is compared with the log.

    Example: crkr render --launcher wide --seed 7 --context 3 trial.png
    Example: crkr render --skill throw --seed 7 throw.gif
    Example: crkr render --trial 2f1c6a1e-6c1f-4b52-9f0e-0d6a3c5b7e11 --slow 4 trial.mp4
    """
    from crkr.client import Client
    from crkr.client.cli.error_lines import require
    from crkr.client.cli.options import parse_ids
    from crkr.client.cli.output_file import check_output
    from crkr.sim_worker.skill import SkillOptions, options_in_force
    from crkr.sim_worker.skill_registry import load_skill, skill_of

    if trial is not None and (launcher is not None or seed or context):
        raise typer.BadParameter("a stored trial has its own context; leave out --launcher, --seed and --context")
    wanted = None if trial is None else parse_ids([trial])[0]
    if out.suffix == ".mp4":
        require("av")

    from crkr.sim_worker.pictures.trial_picture import check_kind, compared, render_trial

    check_kind(out, sequence=sequence, slow=slow)
    check_output(out, overwrite=overwrite)
    asked = SkillOptions(environment=environment, launcher=launcher)
    if task is None and wanted is None:
        player = load_skill(skill or DEFAULT, asked)
        goal = _planned(player, skill or DEFAULT, seed, context)
    else:
        with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
            theirs = client.task(task or DEFAULT)
            name = skill or skill_of(theirs.spec) or DEFAULT
            player = load_skill(name, asked)
            _check_shape(player, theirs)
            if wanted is not None:
                stored = _restored(player, name, theirs, wanted)
                result = render_trial(player, stored.goal, out, sequence=sequence, slow=slow)
                where = options_in_force(player, asked).environment
                played = "played again from the stored state and goal" + (f" in {where}" if where else "")
                stderr.print(f"{out}: trial {stored.id}, {played}: {compared(stored, result)}")
                return
            goal = theirs.predict(_drawn(player, seed, context)).goal
    result = render_trial(player, goal, out, sequence=sequence, slow=slow)
    stderr.print(f"{out}: context {context} of seed {seed}, {result.reason}")


def _drawn(player: Skill, seed: int, context: int) -> Array:
    """Sets up a context of an evaluation and returns its state."""
    from crkr.sim_worker.randomness import fresh_rng
    from crkr.sim_worker.skill import judged_state

    return judged_state(player, context, fresh_rng(seed, context))


def _planned(player: Skill, name: str, seed: int, context: int) -> Array:
    """Sets up a context of an evaluation and returns the planner's goal."""
    from crkr.protocol import Invalid
    from crkr.sim_worker.skill import HasPlan

    if not isinstance(player, HasPlan):
        raise Invalid(f"skill {name!r} tells no plan of its own (a method `plan`); name a task to draw its policy")
    plan = player.plan(_drawn(player, seed, context))
    if plan is None:
        raise Invalid(f"the planner finds nothing for context {context} of seed {seed}; choose another")
    _drawn(player, seed, context)
    return plan[0]


def _check_shape(player: Skill, task: Task) -> None:
    from crkr.protocol import Invalid

    mine, theirs = ((len(spec.state), len(spec.goal)) for spec in (player.spec(), task.spec))
    if mine != theirs:
        raise Invalid(
            f"the skill has states of {mine[0]} and goals of {mine[1]}; task {task.name!r} has {theirs}; "
            "name its skill with --skill"
        )


def _restored(player: Skill, name: str, task: Task, trial_id: UUID) -> Trial:
    """Finds a trial in the task's log by id and sets up its state."""
    from crkr.protocol import Invalid
    from crkr.sim_worker.skill import HasStates

    if not isinstance(player, HasStates):
        raise Invalid(f"skill {name!r} cannot put a stored state (a method `restore`), so no stored trial can be drawn")
    for stored in task.iter_samples():
        if stored.trial.id == trial_id:
            player.restore(stored.trial.state)
            return stored.trial
    raise Invalid(f"task {task.name!r} has no trial {trial_id}; crkr explain and the dashboard show ids")
