"""`crkr status`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, print_table, stdout
from crkr.client.cli.options import Connect, Json, Timeout, ZenohConfig
from crkr.client.tally import wilson_interval
from crkr.protocol import CrkrError, TaskSpec

__all__ = ["named_tasks", "status"]

_MOST_NAMED = 20  # tasks
_LEVEL = 0.05  # change of the success rate that is called none


def status(
    task: Annotated[str | None, typer.Argument(help="Name of a task; without it, the whole server.")] = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Print nothing; exit 0 if the server answers and all its threads run, else 1."),
    ] = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Show the state of the server or of one task.

    Example: crkr status table-tennis
    Example: crkr status --check --timeout 2    (a health probe)
    """
    try:
        with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
            answer = client.info() if task is None else client.task(task).status()
            spec = None if task is None or check or as_json else client.task(task).spec
    except CrkrError as error:
        if check:
            raise typer.Exit(1) from error
        raise
    if check:
        raise typer.Exit(1 if ended_threads(answer) else 0)
    if as_json:
        print_json(answer)
    elif spec is None:
        _show_server(answer)
    else:
        _show_task(answer, spec)


def _show_server(info: Mapping[str, Any]) -> None:
    print_table(
        ("server", ""),
        [
            ("version", info.get("version")),
            ("protocol", info.get("protocol")),
            ("id", info.get("server_id")),
            ("up for", _duration(time.time() - float(info.get("started", time.time())))),
            ("tasks", named_tasks(info)),
            *_threads(info),
        ],
    )


def named_tasks(info: Mapping[str, Any]) -> str:
    """The tasks of an `info` in one line: the first names, and how many more there are."""
    names = info.get("tasks", [])
    more = info.get("task_count", len(names)) - _MOST_NAMED
    listed = ", ".join(names[:_MOST_NAMED]) or "none yet"
    return f"{listed} and {more} more: crkr tasks" if more > 0 else listed


def _show_task(answer: Mapping[str, Any], spec: TaskSpec) -> None:
    rows = _learning(answer)
    for name in ("samples", "eligible", "active", "seq", "model_version", "archived"):
        rows += _rows(name, answer[name]) if name in answer else []
    kernel = dict(answer.get("hyperparameters") or {})
    scales = zip(spec.state, kernel.pop("lengthscales", ()), strict=False)
    rows += [(f"length-scale of {axis.name}", f"{scale:.6g} {axis.unit}".rstrip()) for axis, scale in scales]
    rows += [row for name in kernel for row in _rows(name.replace("_", " "), kernel[name])]
    if "uptime" in answer:
        rows.append(("server up for", _duration(float(answer["uptime"]))))
    rows += [(name, str(answer[name])) for name in ("fault", "damage") if answer.get(name)]
    print_table(("task", str(answer.get("task", ""))), rows + _threads(answer))
    _show_verbs(answer.get("latency_us") or {}, answer.get("queues") or {})
    _show_workers(answer.get("workers") or [], answer.get("more_workers") or 0)


def _learning(answer: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How well it goes, whether that changes, and what limits it."""
    success, drift = answer.get("success"), answer.get("drift")
    rows = []
    if isinstance(success, Mapping):
        rows.append(("success", _trend(success)))
        if success.get("evaluated"):
            rate, count = float(success["evaluation_rate"]), int(success["evaluated"])
            rows.append(("evaluation", f"{_share(rate, count)} of the newest {count} evaluation trials"))
    rows += [("advice", str(one.get("message", one))) for one in answer.get("advice") or []]
    if isinstance(drift, Mapping) and drift.get("restarts"):
        rows.append(("drift", f"{drift['restarts']} restarts of the outcome model, last at {drift.get('last_seq')}"))
    return rows


def _trend(success: Mapping[str, Any]) -> str:
    count, rate, before = int(success.get("trials") or 0), success.get("rate"), success.get("before")
    if not count or rate is None:
        return "no trial yet"
    text = f"{_share(float(rate), count)} of the newest {count} trials"
    if before is None:
        return text
    change = float(rate) - float(before)
    word = "level with" if abs(change) < _LEVEL else "up from" if change > 0 else "down from"
    return f"{text}, {word} {float(before):.0%} in the {count} before"


def _share(rate: float, count: int) -> str:
    low, high = wilson_interval(round(rate * count), count)
    return f"{rate:.0%} ({low:.0%} to {high:.0%})"


def ended_threads(answer: Mapping[str, Any]) -> list[str]:
    """Threads of the server that ended, from an answer to `info` or `status`."""
    threads = answer.get("threads")
    ended = threads.get("ended") if isinstance(threads, Mapping) else None
    return [str(name) for name in ended] if isinstance(ended, list) else []


def thread_faults(answer: Mapping[str, Any]) -> str:
    """Errors that the server's threads survived, in words; "" if there are none."""
    threads = answer.get("threads")
    faults = threads.get("faults") if isinstance(threads, Mapping) else None
    listed = faults.items() if isinstance(faults, Mapping) else ()
    return ", ".join(f"{name} {count}" for name, count in listed)


def _threads(answer: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [("thread faults", thread_faults(answer)), ("threads ended", ", ".join(ended_threads(answer)))]
    return [row for row in rows if row[1]]


def _show_verbs(latency: Mapping[str, Any], queues: Mapping[str, Any]) -> None:
    """Calls since the start, their time inside the server, and the queues."""
    rows = [
        (verb, times.get("count", ""), _text(times.get("p50")), _text(times.get("p99")), _waiting(queues, verb))
        for verb, times in latency.items()
        if isinstance(times, Mapping)
    ]
    if rows:
        print_table(("verb", "calls", "p50 [us]", "p99 [us]", "waiting"), rows)


def _waiting(queues: Mapping[str, Any], verb: str) -> str:
    queue = queues.get(verb)
    return str(queue.get("waiting", "")) if isinstance(queue, Mapping) else ""


def _show_workers(workers: Sequence[Mapping[str, Any]], more: int) -> None:
    if not workers:
        stdout.print("no workers seen")
        return
    columns = ("id", "state", "open_trials")
    rows = [
        (
            *(_text(worker.get(column, "")) for column in columns),
            _age(worker.get("oldest_open_s")),
            _age(worker["last_seen_s"] if "last_seen_s" in worker else _since(worker.get("last_seen"))),
        )
        for worker in workers
    ]
    print_table(("worker", "state", "open trials", "oldest since", "last seen"), rows)
    if more:
        stdout.print(f"and {more} workers more, seen longer ago")


def _since(moment: float | None) -> float | None:
    """Age by this machine's clock, for an older server that sends times of day."""
    return None if moment is None else time.time() - float(moment)


def _age(seconds: float | None) -> str:
    return "" if seconds is None else f"{_duration(float(seconds))} ago"


def _rows(name: str, value: Any) -> list[tuple[str, str]]:
    """One line for each value; nested maps get dotted names."""
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
