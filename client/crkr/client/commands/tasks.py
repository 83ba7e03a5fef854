"""`crkr create` and `crkr tasks`."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated

import typer

from crkr.client import Client
from crkr.client.console import print_json, print_table, stdout
from crkr.client.options import Connect, Json, Timeout, ZenohConfig
from crkr.protocol import Invalid, TaskSpec

__all__ = ["create", "tasks"]


def create(
    spec: Annotated[Path, typer.Argument(exists=True, dir_okay=False, metavar="SPEC.toml", help="What to learn.")],
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Make a task from a specification file; the same file again changes nothing.

    Example: crkr create examples/throw.toml

    That file shows the least that one needs: name, unit, low and high of every coordinate of state and goal.
    """
    try:
        checked = TaskSpec.from_dict(tomllib.loads(spec.read_text()), strict=True)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise Invalid(f"{spec} is not TOML: {error}") from error
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        created = client.create_task(checked).created
    if as_json:
        print_json({"name": checked.name, "created": created})
    else:
        what = "created" if created else "exists already:"
        stdout.print(f"{what} {checked.name} (R^{len(checked.state)} -> R^{len(checked.goal)})")


def tasks(
    connect: Connect = None, timeout: Timeout = 5.0, zenoh_config: ZenohConfig = None, as_json: Json = False
) -> None:
    """List the server's tasks.

    Example: crkr tasks --json
    """
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        found = client.tasks()
    if as_json:
        print_json([{**entry, "spec": entry["spec"].to_dict()} for entry in found])
    elif not found:
        stdout.print("no tasks yet; make one with `crkr create SPEC.toml`")
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
                    "archived" if entry["archived"] else "",
                )
                for entry in found
            ],
        )
