"""`crkr export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, stdout
from crkr.client.cli.options import Connect, Json, Overwrite, Timeout, ZenohConfig
from crkr.client.cli.output_file import check_output
from crkr.client.cli.progress import counting

__all__ = ["export"]

_PAGE: Final = 5000  # trials asked for, and written, together


def export(
    task: Annotated[str, typer.Argument(help="Name of the task.")],
    file: Annotated[Path, typer.Argument(dir_okay=False, help="Where to; .parquet, .csv or .npz says as what.")],
    overwrite: Overwrite = False,
    connect: Connect = None,
    timeout: Timeout = 10.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Write all trials of a task to a file, with their present costs; the server goes on meanwhile.

    Example: crkr export throw throw.parquet

    Settings and fitted numbers are not in it: for a copy of everything, take `crkr backup`.
    """
    from crkr.client.trial_files import Layout, check_kind, writing

    check_kind(file)
    check_output(file, overwrite=overwrite)
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        handle = client.task(task)
        layout, total = Layout(handle.spec), sum(handle.status()["samples"].values())
        done = 0
        with writing(file, layout, overwrite=overwrite) as sink, counting(f"exporting {task}", total) as show:
            following: int | None = 0
            while following is not None:
                page, following = handle.samples(following, _PAGE)
                sink.write(layout.columns(page))
                done += len(page)
                show(done)
    size = file.stat().st_size
    if as_json:
        print_json({"task": task, "file": str(file), "trials": done, "bytes": size})
    else:
        stdout.print(f"{file}: {done} trials, {size} bytes")
