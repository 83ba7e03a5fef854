"""Numbers and tables of a page: the tiles, the workers, the settings."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Final

from crkr.dashboard.page.charts import percent
from crkr.dashboard.page.figures import Figures
from crkr.dashboard.page.markup import Element, card, number, table, tag
from crkr.dashboard.status_facts import advice_lines, worker_rows
from crkr.protocol import TaskSpec

__all__ = ["ago", "settings", "stamp", "tiles", "workers"]

SHOWN_WORKERS: Final = 24


def tiles(figures: Figures, status: Mapping[str, Any], now: float) -> Element:
    """The most important numbers."""
    progress = figures.progress
    shown: list[tuple[str, str, str]] = []
    for name in progress.criteria[:3]:
        curve = figures.success(name)
        if len(curve.trials):
            band = f"{percent(float(curve.low[-1]))} to {percent(float(curve.high[-1]))}"
            shown.append((f"{name}, last {number(curve.count[-1])}", percent(float(curve.value[-1])), band))
    judged = [result for result in progress.epochs.values() if result.balls]
    if judged:
        newest = max(judged, key=lambda result: result.epoch)
        for name in newest.tally.criteria[-1:]:
            low, high = newest.tally.interval(name)
            said = f"{percent(low)} to {percent(high)}, {newest.balls} contexts"
            shown.append((f"evaluation: {name}", percent(newest.tally.rate(name)), said))
    rate = progress.pace.rate(now)
    pace = f"{number(rate, 2)} per s" if rate >= 1 else f"{number(60 * rate, 2)} per min" if rate > 0 else "none lately"
    shown.append(("training trials", number(progress.trials), pace))
    if isinstance(status.get("active"), int) and isinstance(status.get("eligible"), int):
        shown.append(("active samples", number(status["active"]), f"of {number(status['eligible'])} to learn from"))
    if isinstance(status.get("workers"), list):
        alive = sum(worker.state == "alive" for worker in worker_rows(status, progress, 0.0))
        shown.append(("workers alive", number(alive), f"{number(len(progress.workers))} have reported"))
    return tag(
        "div",
        *(
            tag(
                "div", tag("span", name, klass="name"), tag("b", value), tag("span", about, klass="muted"), klass="tile"
            )
            for name, value, about in shown
        ),
        id="tiles",
        klass="tiles",
    )


def workers(figures: Figures, status: Mapping[str, Any], now: float) -> Element:
    """The workers, and when each was heard last."""
    facts = worker_rows(status, figures.progress, 0.0)
    rows = []
    for worker in facts[:SHOWN_WORKERS]:
        heard = figures.heard.get(worker.name)
        since = worker.quiet_s if worker.quiet_s is not None else None if heard is None else now - heard
        seen = tag("i", klass=f"key {'on' if worker.state == 'alive' else 'off'}", title=worker.state)
        rows.append((tag("span", seen, worker.name), number(worker.trials), "" if since is None else ago(since)))
    more = len(facts) - SHOWN_WORKERS
    rest = tag("p", f"and {number(more)} more", klass="muted") if more > 0 else None
    shown = (
        table(("worker", "trials", "last heard"), rows, klass="numbers")
        if rows
        else tag("p", "No worker yet.", klass="empty")
    )
    return card("workers", "Workers", shown, rest)


def settings(spec: TaskSpec, status: Mapping[str, Any]) -> Element:
    """How the task learns."""
    named = status.get("hyperparameters")
    fitted = named if isinstance(named, Mapping) else {}
    scales = fitted.get("lengthscales")
    scales = list(scales) if scales is not None and len(scales) == len(spec.state) else []
    states = [
        (axis.name, axis.unit, f"{number(axis.low)} to {number(axis.high)}", number(float(scale)))
        for axis, scale in zip(spec.state, scales or [axis.lengthscale for axis in spec.state], strict=True)
    ]
    goals = [(axis.name, axis.unit, f"{number(axis.low)} to {number(axis.high)}") for axis in spec.goal]
    rules = [
        ("learns from", spec.learn_from),
        ("active samples, at most", number(spec.budget)),
        ("selection", spec.selector),
        ("exploration", spec.exploration.type),
        ("regularisation", number(spec.regularisation)),
        ("cost", spec.cost),
        ("prior mean", spec.prior_mean),
        ("seed", str(spec.seed)),
    ]
    return card(
        "settings",
        "Settings",
        *(tag("p", text, klass="advice") for text in advice_lines(status)),
        table(("setting", "value"), rules),
        _folded("State", table(("name", "unit", "range", "length-scale"), states)),
        _folded("Goal", table(("name", "unit", "bounds"), goals)),
    )


def _folded(title: str, content: Element) -> Element:
    return tag("details", tag("summary", title), content, data_keep=f"details-{title}")


def ago(seconds: float) -> str:
    """A time ago, for people."""
    seconds = max(seconds, 0.0)
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f}\u202f{unit} ago"
    return f"{seconds:.0f}\u202fs ago"


def stamp(moment: float) -> str:
    """A time of day for people, in the reader's server's zone."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(moment))
