"""`crkr trials`, `crkr amend` and `crkr undo`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, print_table, stdout, tidy
from crkr.client.cli.options import Json, Reason, TaskName, connected, parse_ids, parse_vector
from crkr.client.commands.admin import show_answer
from crkr.protocol import GoalDimension, OutcomeEntry, StateDimension, StoredTrial, TaskSpec

__all__ = ["amend", "trials", "undo"]


@connected(10.0)
def trials(
    client: Client,
    task: TaskName,
    last: Annotated[int, typer.Option("--last", "-n", min=1, help="How many of the newest.")] = 10,
    worst: Annotated[
        bool, typer.Option("--worst", help="Trials of highest cost instead, as in --worst --last 3; reads all trials.")
    ] = False,
    ids: Annotated[list[str] | None, typer.Option("--id", metavar="UUID", help="One trial; may be repeated.")] = None,
    as_json: Json = False,
) -> None:
    """List stored trials with their ids, as they are after all corrections.

    Example: crkr trials throw --last 10
    """
    wanted = parse_ids(ids) if ids else None
    handle = client.task(task)
    if wanted is not None:
        found = handle.trials(id=wanted)
    else:
        found = handle.trials(worst=last) if worst else handle.trials(last=last)
    spec = handle.spec
    if as_json:
        print_json([one.to_wire() for one in found])
        return
    if not found:
        stdout.print(f"task {task} has no such trials yet")
        return
    print_table(("number", "id", "kind", "success", "cost", "state", "goal", "by"), [_row(one) for one in found])
    if len(found) == 1:
        for line in _details(found[0], spec):
            stdout.print(line)


@connected(10.0)
def amend(
    client: Client,
    task: TaskName,
    ids: Annotated[list[str], typer.Argument(metavar="ID...", help="Ids of the trials, from `crkr trials`.")],
    success: Annotated[
        bool | None, typer.Option("--success/--failure", "--hit/--miss", help="Whether the trials succeeded.")
    ] = None,
    cost: Annotated[float | None, typer.Option("--cost", help="In [0, 1].")] = None,
    outcome: Annotated[
        str | None, typer.Option("--outcome", help="Measured numbers, in quotes; nan means not observed.")
    ] = None,
    kind: Annotated[str | None, typer.Option("--kind", help="trial, demonstration, evaluation or failed.")] = None,
    learn: Annotated[
        bool | None, typer.Option("--learn/--ignore", help="Whether goals may be learned from it.")
    ] = None,
    restore: Annotated[bool, typer.Option("--restore", help="Learn from removed trials again.")] = False,
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Correct stored trials; the log keeps what was reported.

    Example: crkr amend throw 2f1c6a1e-6c1f-4b52-9f0e-0d6a3c5b7e11 --miss --reason "it touched the net"
    """
    measured = None if outcome is None else parse_vector(outcome, "--outcome")
    named = parse_ids(ids)
    answer = client.task(task).amend(
        named, success=success, cost=cost, outcome=measured, kind=kind, learn=learn, restore=restore, reason=reason
    )
    show_answer(answer, as_json)


@connected(10.0)
def undo(
    client: Client,
    task: TaskName,
    worker: Annotated[
        str | None, typer.Option("--worker", help="Trials of this worker, instead of those reported by hand.")
    ] = None,
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Take back the newest correction, or the newest trial reported by hand; again goes one step further back.

    Example: crkr undo throw
    """
    answer = client.task(task).undo(worker=worker, reason=reason)
    if as_json:
        print_json(answer)
        return
    stdout.print(f"taken back: {undone(answer)}; the model is at {answer['model_version']}")
    for one in answer["ids"][:10]:
        stdout.print(f"trial id {one}")


def undone(answer: dict[str, Any]) -> str:
    """What an undo took back, in words."""
    what, count = answer["undone"], len(answer["ids"])
    subject = "the trial" if what == "trial" else f"the {what} of {count} trial{'s' if count > 1 else ''}"
    return f"{subject} at number {answer['undone_seq']}"


def _row(stored: StoredTrial) -> tuple[object, ...]:
    trial = stored.trial
    cost = "none" if trial.cost is None else f"{trial.cost:.3f}"
    kind = f"{trial.kind}, removed" if stored.removed else trial.kind
    by = trial.worker or ""
    return stored.seq, trial.id, kind, tidy(trial.success), cost, _short(trial.state), _short(trial.goal), by


def _short(numbers: Sequence[float] | Any) -> str:
    shown = " ".join(f"{number:.3g}" for number in numbers[:4])
    return f"{shown} ..." if len(numbers) > 4 else shown


def _details(stored: StoredTrial, spec: TaskSpec) -> Iterator[str]:
    """All numbers of one trial by name."""
    trial = stored.trial
    measured: list[float] = [] if trial.outcome is None else trial.outcome.tolist()
    values = [*trial.state.tolist(), *trial.goal.tolist(), *measured]
    axes: list[StateDimension | GoalDimension | OutcomeEntry] = [*spec.state, *spec.goal, *spec.outcome]
    for axis, value in zip(axes, values, strict=False):
        yield f"{axis.name} {'not observed' if math.isnan(value) else f'{value:.6g} {axis.unit}'}".rstrip()
    for name, value in trial.info.items():
        yield f"{name}: {tidy(value)}"
