"""`crkr export` and `crkr import`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, stderr, stdout
from crkr.client.cli.options import Connect, Json, Overwrite, Timeout, ZenohConfig
from crkr.client.cli.output_file import check_output
from crkr.client.cli.progress import Progress
from crkr.protocol import Internal

__all__ = ["export", "import_"]

_PAGE: Final = 5000  # trials asked for, and written, together


def export(
    task: Annotated[str, typer.Argument(help="Name of the task.")],
    file: Annotated[Path, typer.Argument(dir_okay=False, help="File to write: .parquet, .csv or .npz.")],
    overwrite: Overwrite = False,
    connect: Connect = None,
    timeout: Timeout = 10.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Write all trials of a task, with their present costs, to a file.

    Example: crkr export throw throw.parquet

    The file has no settings and no fitted numbers; `crkr backup` copies everything.
    """
    from crkr.client.trial_files import Layout, check_kind, trial_sink

    check_kind(file)
    check_output(file, overwrite=overwrite)
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        handle = client.task(task)
        layout, total = Layout(handle.spec), sum(handle.status()["samples"].values())
        done = 0
        bar = Progress(stderr, f"exporting {task}", total, "trials")
        with trial_sink(file, layout, overwrite=overwrite) as sink, bar:
            following: int | None = 0
            while following is not None:
                page, following = handle.samples(following, _PAGE)
                sink.write(layout.columns(page))
                done += len(page)
                bar.show(done)
    size = file.stat().st_size
    if as_json:
        print_json({"task": task, "file": str(file), "trials": done, "bytes": size})
    else:
        stdout.print(f"{file}: {done} trials, {size} bytes")


def import_(
    task: Annotated[str, typer.Argument(help="Name of an existing task.")],
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="File to read: .parquet, .csv or .npz.")],
    connect: Connect = None,
    timeout: Timeout = 60.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Store the trials of a file under their own ids; importing again stores nothing twice.

    Example: crkr create throw.toml; crkr import throw throw.parquet

    A file of another program needs the columns id, kind, success, cost, state.NAME and goal.NAME.
    """
    from crkr.client.trial_files import Layout, check_kind, trial_source
    from crkr.client.trial_files.trial_import import import_rows

    check_kind(file)
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        handle = client.task(task)
        source = trial_source(file, Layout(handle.spec))
        with Progress(stderr, f"importing {file.name}", source.count, "trials") as bar:
            done = import_rows(handle, source.rows, timeout, bar.show)
    if done.accepted + done.duplicates != source.count:
        raise Internal(f"{file} has {source.count} rows, but {done.accepted + done.duplicates} were acknowledged")
    if done.packed:
        stderr.print(f"{done.packed} rows have info that an earlier version took; it is kept as bytes under '$msgpack'")
    if as_json:
        print_json({"task": task, "file": str(file), "trials": source.count, **asdict(done)})
    else:
        removed = f", {done.removed} taken out of learning" if done.removed else ""
        stdout.print(f"{task}: {done.accepted} trials stored, {done.duplicates} known already{removed}")
