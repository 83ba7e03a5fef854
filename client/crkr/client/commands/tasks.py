"""`crkr create` and `crkr tasks`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, print_table, stdout
from crkr.client.cli.options import Json, connected
from crkr.client.commands.spec_files import STANDARD_OUTPUT, read_spec, skill_spec, write_spec
from crkr.protocol import TaskSpec

__all__ = ["create", "tasks"]

_OF_A_SKILL = "Of a skill"


@connected(5.0)
def create(
    client: Client,
    spec: Annotated[
        Path | None,
        typer.Argument(exists=True, dir_okay=False, metavar="SPEC.toml", help="Specification file, .toml or .json."),
    ] = None,
    skill: Annotated[
        str | None,
        typer.Option(
            help="An installed skill, file.py:factory, package.module:factory or gymnasium:ENV-ID.",
            rich_help_panel=_OF_A_SKILL,
        ),
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="Preset of the skill, e.g. tuned.", rich_help_panel=_OF_A_SKILL)
    ] = None,
    launcher: Annotated[
        str | None, typer.Option(help="Where contexts come from, e.g. nominal.", rich_help_panel=_OF_A_SKILL)
    ] = None,
    environment: Annotated[
        str | None, typer.Option(help="Simulator, e.g. contact.", rich_help_panel=_OF_A_SKILL)
    ] = None,
    task: Annotated[
        str | None, typer.Option(help="Name of the task; the skill's own unless given.", rich_help_panel=_OF_A_SKILL)
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, max=2**31 - 1, help="Seed of exploration; 0 unless given.", rich_help_panel=_OF_A_SKILL),
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.json", help="Only write the specification, for editing; - prints it. Needs no server."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Create a task from a specification file or a skill; repeating it changes nothing.

    Example: crkr create examples/throw.toml

    That file has the minimum: name, unit, low and high of every coordinate of state and goal.
    To edit a skill's specification: crkr create --skill table-tennis --preset tuned --write spec.json
    """
    options = {"environment": environment, "launcher": launcher, "preset": preset, "name": task, "seed": seed}
    given = {name: value for name, value in options.items() if value is not None}
    if (spec is None) == (skill is None):
        raise typer.BadParameter("give a specification file or --skill, one of them")
    if spec is not None and given:
        raise typer.BadParameter("a file is complete; these options go with --skill")
    checked = read_spec(spec) if spec is not None else skill_spec(str(skill), **given)
    if write is not None:
        write_spec(checked, write)
        if as_json and write != STANDARD_OUTPUT:
            print_json({"name": checked.name, "written": str(write)})
        elif write != STANDARD_OUTPUT:
            stdout.print(f"wrote {write}: {_what(checked)}; edit it, then: crkr create {write}")
        return
    created = client.create_task(checked).created
    if as_json:
        print_json({"name": checked.name, "created": created})
    else:
        stdout.print(f"{'created' if created else 'exists already:'} {_what(checked)}")


def _what(spec: TaskSpec) -> str:
    return f"{spec.name} (R^{len(spec.state)} -> R^{len(spec.goal)})"


@connected(5.0)
def tasks(client: Client, as_json: Json = False) -> None:
    """List the server's tasks.

    Example: crkr tasks --json
    """
    found = list(client.iter_tasks())
    if as_json:
        print_json([{**entry, "spec": entry["spec"].to_dict()} for entry in found])
    elif not found:
        stdout.print("no tasks yet; make one with `crkr create`")
    else:
        print_table(
            ("task", "states", "goals", "samples", "active", "version", ""),
            [
                (
                    entry["spec"].name,
                    len(entry["spec"].state),
                    len(entry["spec"].goal),
                    entry["samples"],
                    entry["active"],
                    entry["model_version"],
                    "faulty" if "fault" in entry else "archived" if entry["archived"] else "",
                )
                for entry in found
            ],
        )
