"""`crkr page`."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Annotated

import typer

from crkr.client import Client
from crkr.client.cli.console import configure_logging, stderr
from crkr.client.cli.options import Connect, Overwrite, Timeout, ZenohConfig
from crkr.client.cli.output_file import check_output, output_file
from crkr.client.cli.stop_request import StopRequest

__all__ = ["page"]


def page(
    task: Annotated[str | None, typer.Argument(help="Name of the task, e.g. table-tennis.")] = None,
    out: Annotated[Path, typer.Option(dir_okay=False, metavar="REPORT.html", help="The file to write.")] = Path(
        "report.html"
    ),
    overwrite: Overwrite = False,
    skill: Annotated[
        str | None,
        typer.Option(help="Skill that plays the film, as file.py:factory; the task's own unless given."),
    ] = None,
    film: Annotated[bool, typer.Option(help="Play the best and the worst trial again, and show them.")] = True,
    replay: Annotated[
        str | None,
        typer.Option(metavar="DIR|URL", help="Read a server's data directory or database; it may be off."),
    ] = None,
    serve: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Serve live pages of all tasks instead, on loopback unless told."),
    ] = None,
    socket_fd: Annotated[int | None, typer.Option(hidden=True)] = None,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
) -> None:
    """Write one web page about a task: how well it is learned, and where and how it fails.

    The page is a single file. It opens without a network and on a phone. Where
    the task's skill has a scene, it also shows the best and the worst stored
    trial, played again. A skill that cannot put a stored state (`restore`)
    plays some fresh ones, which are not stored.

    Example: crkr page table-tennis --out report.html
    Example: crkr page --serve 127.0.0.1:8080
    """
    if serve is not None:
        if task is not None:
            raise typer.BadParameter("--serve shows all tasks; leave out the task's name")
        _serve(serve, socket_fd, connect, zenoh_config)
        return
    if task is None:
        raise typer.BadParameter("name a task, or serve all with --serve 127.0.0.1:8080")
    from crkr.dashboard.page.played import add_film
    from crkr.dashboard.page.report import read_stored, read_task, written

    check_output(out, overwrite=overwrite)
    if replay is not None:
        view = read_stored(replay, task)
        if film:
            add_film(view.film, view.extremes, skill, view.figures.spec, None)
    else:
        with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
            asked = client.task(task)
            view = read_task(asked)
            if film:
                add_film(view.film, view.extremes, skill, asked.spec, lambda state: asked.predict(state).goal)
    with output_file(out, overwrite=overwrite) as partial:
        partial.write_text(written(view), encoding="utf-8")
    stderr.print(f"{out}: {view.figures.progress.trials} training trials of task {task}")


def _serve(address: str, socket_fd: int | None, connect: str | None, zenoh_config: Path | None) -> None:
    """Serve live pages until stopped; a server that started this process hands over its socket."""
    from crkr.dashboard.web.web_server import TIMEOUT_S, bound, parse_address, shown
    from crkr.dashboard.web.web_server import serve as serve_pages

    configure_logging("warning")
    handed = socket_fd is not None
    listening = socket.socket(fileno=socket_fd) if handed else bound(*parse_address(address))
    with StopRequest() as stop, listening:
        if not handed:
            stderr.print(f"pages of all tasks: {shown(listening)}")
        serve_pages(
            lambda: Client(connect, timeout_s=TIMEOUT_S, zenoh_config=zenoh_config), listening, stop, tied=handed
        )
