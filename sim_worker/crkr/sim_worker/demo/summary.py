"""The result of a demo, and its summary for people."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from rich.console import Console

__all__ = ["DemoResult", "print_summary", "script"]


@final
@dataclass(frozen=True, slots=True)
class DemoResult:
    """The result of a demo.

    Attributes:
        summary: Plain data, as `--json` prints it.
        status: Exit status.
        problem: Why it is not complete, or None.
        stopped_by: Name of the signal that ended it, or None.
        viewer: The viewer's address, or None.
    """

    summary: dict[str, Any]
    status: int
    problem: str | None
    stopped_by: str | None
    viewer: str | None


def script(name: str) -> str:
    """How to start a script of this environment in a shell: by its name where PATH has one, else by its path."""
    return name if shutil.which(name) else _short(str(Path(sys.executable).with_name(name)))


def print_summary(console: Console, result: DemoResult) -> None:
    """Prints the result as aligned lines."""
    rows = list(_rows(result.summary))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        console.print(f"{name:<{width}}  {value}")
    recording = result.summary["recording"]
    if recording:
        console.print(f"{'look again':<{width}}  {script('rerun')} {_short(recording)}")


def _rows(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    before, after = summary.get("success_before"), summary.get("success_after")
    contexts = summary["epochs"][-1]["contexts"] if summary["epochs"] else 0
    yield "success before", _marks(before, contexts)
    yield "success after", _marks(after, contexts)
    rate = f", {summary['trials_per_second']:.0f}/s" if summary["trials_per_second"] else ""
    yield "training trials", f"{summary['trials']} after {summary['demonstrations']} demonstrations{rate}"
    yield "samples", f"{summary['samples']} stored, {summary['active']} active"
    lost = f", {summary['workers_lost']} lost" if summary["workers_lost"] else ""
    yield "workers", f"{summary['workers']}{lost}"
    yield "time", f"{summary['wall_seconds']:.1f} s"
    for name in ("figure", "recording", "data"):
        if summary[name]:
            yield name, _short(summary[name])


def _marks(rates: Mapping[str, float] | None, contexts: int) -> str:
    if rates is None:
        return "not judged"
    return ", ".join(f"{name} {rate:.0%}" for name, rate in rates.items()) + f" of {contexts} fixed contexts"


def _short(path: str) -> str:
    """Relative to the working directory where it is inside it."""
    here = Path.cwd()
    return str(Path(path).relative_to(here)) if Path(path).is_relative_to(here) else path
