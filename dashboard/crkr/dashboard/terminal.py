"""The display for a terminal: tables that are redrawn, or a line every few seconds where the output is no terminal."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final, final

from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Column, Table
from rich.text import Text

from crkr.dashboard.progress import EpochResult, Progress, Row
from crkr.dashboard.status_facts import (
    advice_lines,
    latency_ms,
    percent,
    reason_rows,
    recent_workers,
    server_time,
    worker_rows,
)
from crkr.dashboard.telemetry import Telemetry
from crkr.protocol import printable

__all__ = ["TerminalDisplay", "sparkline"]

BARS: Final = "▁▂▃▄▅▆▇█"
LINE_EVERY_S: Final = 5.0
RENEW_EVERY_S: Final = 0.5
MESSAGES: Final = 5


def sparkline(shares: Sequence[float], width: int = 40) -> str:
    """Shares in [0, 1] as bars, the newest `width` of them."""
    return "".join(BARS[min(len(BARS) - 1, int(len(BARS) * max(share, 0.0)))] for share in shares[-width:])


def _text(line: str, style: str = "") -> Text:
    """A line that wraps on a narrow terminal."""
    return Text(printable(line), style=style, no_wrap=False, overflow="fold")


def _table(*columns: str) -> Table:
    """A table whose cells take more lines on a narrow terminal."""
    return Table(*(Column(name, overflow="fold") for name in columns))


@final
class TerminalDisplay:
    """A run as text; implements `View`, and is a context manager.

    Args:
        console: Where to.
        task: The task's name.
        replayed: Whether the run is over: then only `finish` shows the tables.
    """

    def __init__(self, console: Console, task: str, *, replayed: bool = False) -> None:
        self._console = console
        self._task = task
        self._replayed = replayed
        is_live = console.is_terminal and not replayed
        self._live = Live(console=console, auto_refresh=False, transient=False) if is_live else None
        self._description = ""
        self._status: Mapping[str, Any] = {}
        self._answered = 0.0
        self._messages: deque[str] = deque(maxlen=MESSAGES)
        self._next = 0.0
        self._said = -1

    def __enter__(self) -> TerminalDisplay:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def task(self, description: str) -> None:
        """Keep the description for the head of the tables."""
        self._description = description

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        """Show nothing: `progress` has counted them."""

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """Show nothing: a terminal has no use for poses."""

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        """Print the success rates of an evaluation."""
        del progress  # Unused.
        rates = ", ".join(f"{name} {rate:.2f}" for name, rate in result.tally.rates().items())
        self.say(f"epoch {result.epoch}: {rates} of {result.balls} evaluation trials")

    def status(self, status: Mapping[str, Any], progress: Progress, now: float) -> None:
        """Keep the status for the next refresh."""
        del progress  # Unused.
        self._status, self._answered = status, now

    def say(self, message: str, *, warning: bool = False) -> None:
        """Print a line, beneath the tables if they are shown."""
        line = printable(f"warning: {message}" if warning else message)
        self._messages.append(line)
        if self._live is None and not self._replayed:
            self._console.print(line)

    def tick(self, now: float, progress: Progress) -> None:
        """Redraw the tables, or print a line when there is something new."""
        if now < self._next:
            return
        if self._replayed:
            self._next = now + RENEW_EVERY_S
        elif self._live is not None:
            self._next = now + RENEW_EVERY_S
            self._live.update(self.page(progress, now), refresh=True)
        elif progress.seq != self._said:
            self._next = now + LINE_EVERY_S
            self._said = progress.seq
            self._console.print(self._line(progress, now))

    def finish(self, progress: Progress) -> None:
        """Show the end of the run."""
        if self._replayed:
            self._console.print(self.page(progress, self._answered), soft_wrap=False)
            return
        self._next = 0.0
        self._said = -1
        self.tick(time.monotonic(), progress)

    def page(self, progress: Progress, now: float) -> RenderableType:
        """All tables; `now` is monotonic [s]."""
        tables = [
            self._success(progress),
            self._predictions(progress),
            self._reasons(progress),
            self._workers(progress, now),
            self._server(),
        ]
        shown = [table for table in tables if table.row_count]
        head, about = _text(self._line(progress, now), "bold"), _text(self._description, "dim")
        advice = [_text(f"advice: {line}", "yellow") for line in advice_lines(self._status)]
        return Panel(
            Group(head, about, *advice, Text(), Columns(shown, padding=(0, 3)), *map(_text, self._messages)),
            title=_text(f"crkr watch {self._task}"),
            title_align="left",
        )

    def _line(self, progress: Progress, now: float) -> str:
        status = self._status
        rates = {name: progress.window.rate(name) for name in progress.criteria}
        success = ", ".join(f"{name} {percent(rate)}" for name, rate in rates.items() if rate is not None)
        return printable(
            f"training trials {progress.trials}  {progress.pace.rate(self._clock(now)):.1f}/s  epoch {progress.epoch}  "
            f"active {status.get('active', '-')} of {status.get('eligible', '-')} samples"
            + (f"  last 50: {success}" if len(progress.window) else "")
        )

    def _clock(self, now: float) -> float:
        """The server's clock; for a stored run, `now`, which is its time."""
        return now if self._replayed else server_time(self._status, now - self._answered)

    def _success(self, progress: Progress) -> Table:
        table = _table("evaluation", "by epoch", "first", "newest", "95 % interval")
        results = sorted((r for r in progress.epochs.values() if r.closed), key=lambda result: result.epoch)
        for name in progress.criteria if results else ():
            judged = [result.tally for result in results if result.tally.judged[name]]
            if not judged:
                continue
            rates = [tally.rate(name) for tally in judged]
            low, high = judged[-1].interval(name)
            table.add_row(
                _text(name),
                sparkline(rates),
                percent(rates[0]),
                percent(rates[-1]),
                f"{100 * low:.0f} - {100 * high:.0f} %",
            )
        return table

    def _predictions(self, progress: Progress) -> Table:
        table = _table("predictions", "last 200")
        for name, share in progress.predictions.shares().items():
            table.add_row(_text(name), percent(share))
        return table

    def _reasons(self, progress: Progress) -> Table:
        table = _table("how trials end", "count", "share", "last 50")
        for reason, count, share, lately in reason_rows(progress)[:12]:
            table.add_row(_text(reason), str(count), percent(share), percent(lately))
        return table

    def _workers(self, progress: Progress, now: float) -> Table:
        table = _table("worker", "state", "reported", "last heard")
        shown, others = recent_workers(worker_rows(self._status, progress, now - self._answered), 12)
        for worker in shown:
            quiet = "" if worker.quiet_s is None else f"{worker.quiet_s:.0f} s"
            table.add_row(_text(worker.name), _text(worker.state), str(worker.trials), quiet)
        if others:
            table.add_row(_text(f"{others} more"), _text("gone"), "", "")
        return table

    def _server(self) -> Table:
        table = _table("asked of the server", "median", "p99")
        for verb, (p50, p99) in sorted(latency_ms(self._status).items()):
            table.add_row(_text(verb), f"{p50:.2f} ms", f"{p99:.2f} ms")
        return table
