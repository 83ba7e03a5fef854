"""`crkr recost`, `remove`, `refit`, `configure`, `rollback`, `rename`, `archive` and `delete`."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import typer

from crkr.client import Client
from crkr.client.cli.console import json_data, print_json, stderr, stdout, tidy
from crkr.client.cli.options import Json, Reason, TaskName, connected, parse_ids
from crkr.protocol import Invalid

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["archive", "configure", "delete", "recost", "refit", "remove", "rename", "rollback", "show_answer"]


@connected(10.0)
def recost(
    client: Client,
    task: TaskName,
    changes: Annotated[list[str], typer.Argument(metavar="ID=COST...", help="New costs in [0, 1].")],
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Correct the costs of stored trials.

    Example: crkr recost throw 2f1c6a1e-6c1f-4b52-9f0e-0d6a3c5b7e11=0.4 --reason "camera was off"
    """
    pairs = [change.partition("=") for change in changes]
    ids = parse_ids([pair[0] for pair in pairs])
    try:
        costs = [float(pair[2]) for pair in pairs]
    except ValueError as error:
        raise typer.BadParameter("each change is ID=COST with a number for the cost") from error
    show_answer(client.task(task).recost(ids, costs, reason), as_json)


@connected(10.0)
def remove(
    client: Client,
    task: TaskName,
    ids: Annotated[list[str], typer.Argument(metavar="ID...", help="Ids of the trials to remove from the model.")],
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Remove trials from the model; the log keeps them, marked.

    Example: crkr remove throw 2f1c6a1e-6c1f-4b52-9f0e-0d6a3c5b7e11 --reason "hand slipped"
    """
    show_answer(client.task(task).remove(parse_ids(ids), reason), as_json)


@connected(60.0)
def refit(
    client: Client,
    task: TaskName,
    as_json: Json = False,
) -> None:
    """Fit the kernel's length-scales to the evidence; kept only if it improves.

    Example: crkr refit throw
    """
    show_answer(client.task(task).refit(), as_json)


@connected(10.0)
def configure(
    client: Client,
    task: TaskName,
    changes: Annotated[list[str], typer.Argument(metavar="KEY=VALUE...", help="Settings, as in the specification.")],
    as_json: Json = False,
) -> None:
    """Change settings of a task while it runs.

    Example: crkr configure throw budget=400 cost_map=odds kernel.linear_weight=0.1
    """
    wanted = _settings(changes)
    handle = client.task(task)
    before = {} if as_json else handle.spec.to_dict()
    answer = handle.configure(wanted)
    if as_json:
        print_json(answer)
        return
    changed = list(_changed(before, answer["spec"]))
    for line in [*(changed or ["nothing changed"]), *_fitted(answer)]:
        stdout.print(line)


@connected(10.0)
def archive(
    client: Client,
    task: TaskName,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    as_json: Json = False,
) -> None:
    """End the learning of a task for good; it still answers and keeps its data.

    Example: crkr archive throw --yes
    """
    if not yes:
        _confirm(f"End learning of {task} for good?", f"to archive without a question: crkr archive {task} --yes")
    show_answer(client.task(task).archive(), as_json)


@connected(60.0)
def rollback(
    client: Client,
    task: TaskName,
    to: Annotated[
        int,
        typer.Option(
            "--to", min=1, help="Version to go back to: the number of the last trial to keep, from `crkr trials`."
        ),
    ],
    reason: Reason = "",
    as_json: Json = False,
) -> None:
    """Go back to the policy of an earlier version; nothing is lost, and a later version can be gone back to.

    Example: crkr rollback throw --to 120 --reason "the camera was off since then"
    """
    show_answer(client.task(task).rollback(to, reason), as_json)


@connected(10.0)
def rename(
    client: Client,
    task: TaskName,
    name: Annotated[str, typer.Argument(help="The new name.")],
    as_json: Json = False,
) -> None:
    """Give a task another name.

    Example: crkr rename throw throw-left
    """
    show_answer(client.task(task).rename(name), as_json)


@connected(10.0)
def delete(
    client: Client,
    task: TaskName,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    as_json: Json = False,
) -> None:
    """Take a task out of service and free its name; the log and its backups keep it until `crkr purge`.

    Example: crkr delete throw --yes
    """
    if not yes:
        _confirm(f"Delete task {task}?", f"to delete without a question: crkr delete {task} --yes")
    show_answer(client.task(task).delete(), as_json)


def _settings(changes: list[str]) -> dict[str, Any]:
    """key=value pairs as TOML values; a bare word is text, a dotted key goes into its map."""
    settings: dict[str, Any] = {}
    for change in changes:
        key, equals, text = change.partition("=")
        if not key or not equals:
            raise typer.BadParameter(f"a change is KEY=VALUE, as in budget=400; got {change!r}")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text
        outer, dot, inner = key.partition(".")
        if dot:
            settings.setdefault(outer, {})[inner] = value
        else:
            settings[key] = value
    return settings


def _confirm(question: str, otherwise: str) -> None:
    try:
        agreed = typer.confirm(question, err=True)
    except typer.Abort as error:
        if sys.stdin.isatty():
            raise
        stderr.print()  # ends the question's line
        raise Invalid(f"no answer; {otherwise}") from error
    if not agreed:
        raise typer.Abort


def _changed(before: Mapping[str, Any], after: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """One line for each changed setting; settings in a map get dotted names."""
    for name, value in after.items():
        old = before.get(name)
        if isinstance(value, Mapping) and isinstance(old, Mapping):
            yield from _changed(old, value, f"{prefix}{name}.")
        elif value != old:
            yield f"{prefix}{name} {tidy(old)} -> {tidy(value)}"


def _fitted(answer: Mapping[str, Any]) -> Iterator[str]:
    """One line for each fitted number of the kernel that differs from the specification."""
    spec, force = answer["spec"], answer.get("hyperparameters", {})
    given = {
        "lengthscales": [axis["lengthscale"] for axis in spec["state"]],
        "signal_variance": spec["kernel"]["signal_variance"],
    }
    for name, value in given.items():
        fitted = json_data(force.get(name, value))
        if fitted != value:
            yield f"in force: {name} {tidy(fitted)}, fitted (the specification says {tidy(value)})"


def show_answer(answer: Mapping[str, Any], as_json: bool) -> None:
    """Prints an answer, a line for each field."""
    if as_json:
        print_json(answer)
        return
    for key, value in answer.items():
        stdout.print(f"{key.replace('_', ' ')}: {tidy(value)}")
