"""`crkr status`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from crkr.client import Client
from crkr.client.console import print_json, print_table, stdout
from crkr.client.options import Connect, Json, Timeout, ZenohConfig

__all__ = ["status"]


def status(
    task: Annotated[str | None, typer.Argument(help="Name of a task; the whole server unless given.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Print nothing; exit 0 if it answers, 1 if not.")] = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Show what the server, or one task, is doing.

    Example: crkr status table-tennis        For health probes: crkr status --check --timeout 2
    """
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        answer = client.info() if task is None else client.task(task).status()
    if check:
        return
    if as_json:
        print_json(answer)
    elif task is None:
        _show_server(answer)
    else:
        _show_task(answer)


def _show_server(info: Mapping[str, Any]) -> None:
    print_table(
        ("server", ""),
        [
            ("version", info.get("version")),
            ("protocol", info.get("protocol")),
            ("id", info.get("server_id")),
            ("up for", _duration(time.time() - float(info.get("started", time.time())))),
            ("tasks", ", ".join(info.get("tasks", [])) or "none yet"),
        ],
    )


def _show_task(answer: Mapping[str, Any]) -> None:
    rows: list[tuple[str, str]] = []
    for name in ("samples", "eligible", "active", "seq", "model_version", "hyperparameters", "queues", "latency_us"):
        if name in answer:
            rows += _rows(name, answer[name])
    if "uptime" in answer:
        rows.append(("uptime", _duration(float(answer["uptime"]))))
    print_table(("", ""), rows)
    workers = answer.get("workers") or []
    if workers:
        columns = list(dict.fromkeys(str(key) for worker in workers for key in worker))
        print_table(columns, [[_text(worker.get(key, "")) for key in columns] for worker in workers], title="workers")
    else:
        stdout.print("no workers seen")


def _rows(name: str, value: Any) -> list[tuple[str, str]]:
    """A line a value; nested maps get dotted names."""
    if isinstance(value, Mapping):
        return [row for key, entry in value.items() for row in _rows(f"{name}.{key}", entry)]
    return [(name, _text(value))]


def _text(value: Any) -> str:
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list):
        return " ".join(_text(entry) for entry in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"
