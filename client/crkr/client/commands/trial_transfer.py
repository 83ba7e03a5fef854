"""`crkr export`, `crkr import` and `crkr warm-start`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final

import typer

from crkr.client import Client, Task
from crkr.client.cli.console import print_json, stderr, stdout
from crkr.client.cli.options import Connect, Json, Overwrite, TaskName, Timeout, ZenohConfig, connected
from crkr.client.cli.output_file import check_output
from crkr.client.cli.progress import Progress
from crkr.protocol import Internal, Invalid

__all__ = ["export", "import_", "warm_start"]

_PAGE: Final = 5000  # trials asked for, and written, together


@connected(10.0)
def export(
    client: Client,
    task: TaskName,
    file: Annotated[Path, typer.Argument(dir_okay=False, help="File to write: .parquet, .csv or .npz.")],
    policy: Annotated[
        bool, typer.Option("--policy", help="Write the policy instead, as .npz, which NumPy alone evaluates, or .onnx.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Write all trials of a task, as they are after all corrections, to a file.

    Example: crkr export throw throw.parquet

    Example: crkr export throw policy.npz --policy

    The file has no settings and no fitted numbers; `crkr backup` copies everything.
    """
    from crkr.client.trial_files import Layout, check_kind, trial_sink

    if policy:
        _export_policy(client.task(task), file, as_json, overwrite=overwrite)
        return
    check_kind(file)
    check_output(file, overwrite=overwrite)
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


def _export_policy(task: Task, file: Path, as_json: bool, *, overwrite: bool) -> None:
    if file.suffix.lower() not in (".npz", ".onnx"):
        raise Invalid(f"a policy is written as .npz or .onnx; got {file.name!r}")
    check_output(file, overwrite=overwrite)
    from crkr.client.mirror.policy_file import save_policy

    version = save_policy(task, file, overwrite=overwrite)
    if as_json:
        print_json({"task": task.name, "file": str(file), "model_version": version, "bytes": file.stat().st_size})
    else:
        stdout.print(f"{file}: policy of version {version}, {file.stat().st_size} bytes")


def warm_start(
    task: Annotated[str, typer.Argument(help="Name of an existing task, whose specification may differ.")],
    source: Annotated[str, typer.Option("--from", metavar="TASK", help="Task whose trials are taken.")],
    columns: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="NEW=OLD", help='Source of a coordinate, as "goal.speed=0.01 * goal.v + 2".'),
    ] = None,
    connect: Connect = None,
    timeout: Timeout = 60.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Start a task from another's trials; coordinates of the same name are taken over, others are mapped.

    Example: crkr warm-start throw-far --from throw --map goal.speed=goal.v --map goal.spin=0

    Goals outside the task's bounds are skipped. Repeating it stores nothing twice.
    """
    from crkr.client.trial_files import warm_start as start

    mapped: dict[str, str | float] = {}
    for one in columns or []:
        name, equals, old = one.partition("=")
        if not equals:
            raise typer.BadParameter(f"a mapping is NEW=OLD, as goal.speed=goal.v; got {one!r}")
        mapped[name.strip()] = old.strip()
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        begun, taken = client.task(task), client.task(source)
        total = sum(taken.status()["samples"].values())
        with Progress(stderr, f"starting {task}", total, "trials") as bar:
            done = start(begun, taken, mapped, timeout_s=timeout, progress=bar.show)
    if as_json:
        print_json({"task": task, "from": source, **asdict(done)})
    else:
        rest = f"{done.duplicates} known already, {done.skipped} skipped"
        stdout.print(f"{task}: {done.accepted} trials of {source} stored, {rest}")


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
