"""`crkr import`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, stderr, stdout
from crkr.client.cli.options import Connect, Json, Timeout, ZenohConfig
from crkr.client.cli.progress import counting
from crkr.protocol import Internal

__all__ = ["import_"]


def import_(
    task: Annotated[str, typer.Argument(help="Name of the task, which must exist.")],
    file: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="A .parquet, .csv or .npz of `crkr export`.")
    ],
    connect: Connect = None,
    timeout: Timeout = 60.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Report the trials of a file, under the ids that they have there; doing it again stores nothing twice.

    Example: crkr create throw.toml; crkr import throw throw.parquet

    A file that something else wrote needs the columns id, kind, success, cost, state.NAME and goal.NAME.
    """
    from crkr.client.trial_files import Layout, check_kind, reading
    from crkr.client.trial_files.trial_import import import_rows

    check_kind(file)
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        handle = client.task(task)
        source = reading(file, Layout(handle.spec))
        with counting(f"importing {file.name}", source.count) as show:
            done = import_rows(handle, source.rows, timeout, show)
    if done.accepted + done.duplicates != source.count:
        raise Internal(f"{file} has {source.count} rows, but {done.accepted + done.duplicates} were acknowledged")
    if done.packed:
        stderr.print(f"{done.packed} rows have info that an earlier version took; it is kept as bytes under '$msgpack'")
    if as_json:
        print_json({"task": task, "file": str(file), "trials": source.count, **asdict(done)})
    else:
        removed = f", {done.removed} taken out of learning" if done.removed else ""
        stdout.print(f"{task}: {done.accepted} trials stored, {done.duplicates} known already{removed}")
