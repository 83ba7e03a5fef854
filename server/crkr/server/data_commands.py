"""`crkr replay`, `backup`, `copy` and `purge`: look at logs, copy them, and remove deleted tasks."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from crkr.server.inspection.verification import Verdict
    from crkr.server.log import LogReader

__all__ = ["backup", "copy", "purge", "replay"]

DIR_OR_URL = "DIR|URL"
Data = Annotated[
    str, typer.Argument(metavar=DIR_OR_URL, help="Data directory or database of a server.", show_default=False)
]


def replay(
    data: Data,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON value for programs.")] = False,
) -> None:
    """Check that a log is whole and that log and model agree.

    Example: crkr replay crkr-data
    """
    from crkr.protocol import StorageError, printable
    from crkr.server.log import read_log
    from crkr.server.log.postgres.url import printable_location

    reader = read_log(data)
    try:
        verdicts, problems = _check(reader)
    finally:
        reader.close()
    if as_json:
        found = {"agree": not problems, "problems": problems, "tasks": [asdict(verdict) for verdict in verdicts]}
        typer.echo(json.dumps(found).replace("\x7f", "\\u007f"))
    else:
        for verdict in verdicts:
            typer.echo(
                f"{printable(verdict.task)}: {verdict.entries} log positions, {verdict.samples} samples, "
                f"{verdict.active} active, predictions agree to {verdict.largest_difference:.1e}"
            )
    if problems:
        raise StorageError(f"{printable_location(data)} does not agree with itself: {'; '.join(problems)}")
    if not as_json:
        typer.echo(f"{printable(printable_location(data))}: log and model agree, {len(verdicts)} tasks")


def purge(
    data: Data,
    yes: Annotated[bool, typer.Option("--yes", help="Remove them; without it they are only listed.")] = False,
    restore: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Bring this deleted task back, under the name it had; either name will do."),
    ] = None,
) -> None:
    """List deleted tasks, and with --yes remove them from the log for good.

    Stop the server first. Backups that were made before keep the tasks.

    Example: crkr purge crkr-data --yes
    """
    from crkr.protocol import Invalid, printable
    from crkr.server.log import DELETED
    from crkr.server.log.access import open_unserved
    from crkr.server.log.postgres.url import printable_location

    if restore is not None and yes:
        raise typer.BadParameter("--restore brings a task back and --yes removes all of them: give one of the two")
    log = open_unserved(data)
    try:
        gone = [name for name in log.reads.tasks() if name.startswith(DELETED)]
        if restore is not None:
            meant = [name for name in gone if restore in (name, _earlier(name))]
            if len(meant) != 1:
                found = "are several deleted tasks" if meant else "is no deleted task"
                raise Invalid(f"there {found} {restore!r}; choose one of: {', '.join(meant or gone) or 'none'}")
            back = _earlier(meant[0])
            if back in log.reads.tasks():
                raise Invalid(f"there is another task {back!r} now; rename that first")
            log.append_event(meant[0], "rename", {"name": back})
            typer.echo(f"{printable(back)} is back")
            return
        for name in log.purge() if yes else gone:
            typer.echo(f"{printable(name)}{' is removed' if yes else ''}")
        if not gone:
            typer.echo(f"{printable(printable_location(data))}: no deleted tasks")
    finally:
        log.close()


def _earlier(name: str) -> str:
    """The name that a deleted task had."""
    from crkr.server.log import DELETED

    return name.removeprefix(DELETED).partition("/")[0]


def backup(
    data: Data,
    target: Annotated[Path, typer.Argument(help="New file to write.", show_default=False)],
) -> None:
    """Copy a log into one file, also while a server uses it.

    To restore, put the file into an empty directory under the name crkr.sqlite3. To restore to PostgreSQL,
    `crkr copy` that directory.

    Example: crkr backup crkr-data monday.sqlite3
    """
    from crkr.protocol import printable
    from crkr.server.log.access import database_file
    from crkr.server.log.postgres.url import is_url
    from crkr.server.log.sqlite_database import SqliteDatabase

    if is_url(data):
        from crkr.server.log import read_log
        from crkr.server.log.access import copy_to_file

        reader = read_log(data)
        try:
            copy_to_file(reader, target)
        finally:
            reader.close()
    else:
        database = SqliteDatabase(database_file(data))
        try:
            database.backup(target)
        finally:
            database.close()
    typer.echo(f"{printable(str(target))}: {target.stat().st_size} bytes")


def copy(
    source: Annotated[
        str, typer.Argument(metavar=DIR_OR_URL, help="Log to copy from; a server may use it.", show_default=False)
    ],
    target: Annotated[
        str, typer.Argument(metavar=DIR_OR_URL, help="Log to copy into; no server may use it.", show_default=False)
    ],
    task: Annotated[list[str] | None, typer.Option("--task", help="Only this task; may be given again.")] = None,
) -> None:
    """Copy tasks between data directories and databases, and check them.

    What the server of the source stores meanwhile is not copied: stop it first, or let it archive the task.

    Example: crkr copy crkr-data postgresql://host/crkr
    """
    from crkr.protocol import StorageError, printable
    from crkr.server.log import read_log
    from crkr.server.log.access import copy_tasks, open_unserved
    from crkr.server.log.postgres.url import printable_location

    reader = read_log(source)
    try:
        log = open_unserved(target)
        try:
            names = copy_tasks(reader, log, task or (), lambda name, n: typer.echo(f"{printable(name)}: {n} entries"))
            _, problems = _check(log.reads, names)
        finally:
            log.close()
    finally:
        reader.close()
    shown = printable_location(target)
    if problems:
        raise StorageError(f"the copy in {shown} does not agree with itself: {'; '.join(problems)}")
    typer.echo(f"{printable(shown)}: log and model agree, {len(names)} tasks copied")


def _check(reader: LogReader, names: Sequence[str] = ()) -> tuple[list[Verdict], list[str]]:
    """What verification finds of these tasks, or all of them, and everything that does not agree."""
    from rich.console import Console

    from crkr.protocol import printable
    from crkr.server.inspection.verification import verify

    watched = sys.stderr.isatty()
    errors = Console(stderr=True, soft_wrap=True, markup=False, highlight=False, emoji=False, quiet=not watched)
    with reader.snapshot(), errors.status("checking the database") as status:
        damage = [*reader.integrity(), *filter(None, [reader.lost_end()])]
        verdicts = []
        for name in names or reader.tasks():
            last = reader.last(name)
            verdicts.append(
                verify(reader, name, lambda at, n=name, of=last: status.update(f"{printable(n)}: {at} of {of}"))  # type: ignore[misc]  # the defaults bind the loop's values
            )
    return verdicts, [*damage, *(f"{verdict.task}: {problem}" for verdict in verdicts for problem in verdict.problems)]
