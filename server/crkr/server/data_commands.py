"""`crkr replay`, `crkr backup` and `crkr purge`: look at a data directory, copy it, rid it of deleted tasks."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["backup", "purge", "replay"]

DataDirectory = Annotated[Path, typer.Argument(help="Data directory of a server.", show_default=False)]


def replay(
    data: DataDirectory,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON value for programs.")] = False,
) -> None:
    """Check that a data directory's log is whole and that log and model agree: `crkr replay crkr-data`."""
    from rich.console import Console

    from crkr.protocol import StorageError, printable
    from crkr.server.inspection.verification import verify
    from crkr.server.log import SqliteReader
    from crkr.server.log.acknowledged_count import lost_end, read_tally
    from crkr.server.log.schema import FILE_NAME

    watched = sys.stderr.isatty()
    errors = Console(stderr=True, soft_wrap=True, markup=False, highlight=False, emoji=False, quiet=not watched)
    acknowledged = read_tally(data)  # before the log, which a server may add to meanwhile
    reader = SqliteReader(data / FILE_NAME)
    try:
        with reader.snapshot(), errors.status("checking the database") as status:
            damage, held = reader.integrity(), sum(reader.positions().values())
            if held < acknowledged:
                damage.append(lost_end(reader.path, held, acknowledged))
            verdicts = []
            for name in reader.tasks():
                last = reader.last(name)
                verdicts.append(
                    verify(reader, name, lambda at, n=name, of=last: status.update(f"{printable(n)}: {at} of {of}"))  # type: ignore[misc]  # the defaults bind the loop's values
                )
    finally:
        reader.close()
    problems = [*damage, *(f"{verdict.task}: {problem}" for verdict in verdicts for problem in verdict.problems)]
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
        raise StorageError(f"{data} does not agree with itself: {'; '.join(problems)}")
    if not as_json:
        typer.echo(f"{printable(str(data))}: log and model agree, {len(verdicts)} tasks")


def purge(
    data: DataDirectory,
    yes: Annotated[bool, typer.Option("--yes", help="Remove them; without it they are only listed.")] = False,
    restore: Annotated[
        str | None, typer.Option(metavar="NAME", help="Bring this deleted task back, under the name it had.")
    ] = None,
) -> None:
    """List deleted tasks, and with --yes remove them from the log for good: `crkr purge crkr-data --yes`.

    Stop the server first. Backups that were made before keep the tasks.
    """
    from crkr.protocol import Invalid, printable
    from crkr.server.log import DELETED, SqliteLog

    log = SqliteLog(data)
    try:
        gone = [name for name in log.reads.tasks() if name.startswith(DELETED)]
        if restore is not None:
            if restore not in gone:
                raise Invalid(f"there is no deleted task {restore!r}; there are: {', '.join(gone) or 'none'}")
            back = restore.removeprefix(DELETED).partition("/")[0]
            if back in log.reads.tasks():
                raise Invalid(f"there is another task {back!r} now; rename that first")
            log.append_event(restore, "rename", {"name": back})
            typer.echo(f"{printable(back)} is back")
            return
        for name in log.purge() if yes else gone:
            typer.echo(f"{printable(name)}{' is removed' if yes else ''}")
        if not gone:
            typer.echo(f"{printable(str(data))}: no deleted tasks")
    finally:
        log.close()


def backup(
    data: DataDirectory,
    target: Annotated[Path, typer.Argument(help="New file to write.", show_default=False)],
) -> None:
    """Copy a data directory's log into one file, also while a server uses it: `crkr backup crkr-data monday.sqlite3`.

    To restore, put the file into an empty directory under the name crkr.sqlite3.
    """
    from crkr.protocol import printable
    from crkr.server.log import SqliteReader
    from crkr.server.log.schema import FILE_NAME

    reader = SqliteReader(data / FILE_NAME)
    try:
        reader.backup(target)
    finally:
        reader.close()
    typer.echo(f"{printable(str(target))}: {target.stat().st_size} bytes")
