"""The text panels, as markdown."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from crkr.dashboard.progress import WINDOW, Progress
from crkr.dashboard.status_facts import advice_lines, latency_ms, percent, reason_rows, recent_workers, worker_rows
from crkr.protocol import printable

__all__ = ["guide_page", "outcomes_page", "status_page"]

GUIDE: Final = f"""\
**Cost** says how good a training trial was, from 0 (best) to 1 (worst), as the task's skill measures it; what cost less
weighs more in what is learned. It is not success: a trial may succeed and still have a high cost.

**Success** is the share of trials that met a criterion of the skill. Thick: evaluations, which try the best known goals
in the same situations each time, with a 95 % interval. Thin: the last {WINDOW} training trials, which explore.

**Sigma** is how widely goals are explored, 1 being the width that the task calls typical. **Novelty** is how unlike all
active samples a situation is, from 0 to 1.

**Active set**: the samples that predictions rest on, of all that are good enough (eligible).

An **epoch** is what is trained between two evaluations. Another horizontal axis than `trial`, chosen at the bottom, is
`epoch` or `log_time`.
"""


def status_page(
    task: str,
    status: Mapping[str, Any],
    status_age_s: float,
    progress: Progress,
    trials_per_second: float,
    remark: str = "",
) -> str:
    """The run in numbers; the server answered `status` `status_age_s` ago, and `remark` is the last line."""
    newest = max((result for result in progress.epochs.values() if result.closed), default=None, key=lambda r: r.epoch)
    kinds = progress.kinds
    shown, others = recent_workers(worker_rows(status, progress, status_age_s), 16)
    lines = [
        f"**{_plain(task)}**: **{progress.trials}** training trials, **{trials_per_second:.1f}**/s, "
        f"epoch **{progress.epoch}**",
        "",
    ]
    if newest is not None:
        rates = ", ".join(f"{_plain(name)} **{percent(rate)}**" for name, rate in newest.tally.rates().items())
        lines += [f"Evaluation {newest.epoch} ({newest.balls} trials): {rates}", ""]
    if shares := progress.predictions.shares():
        lines += [", ".join(f"{name} **{percent(share)}**" for name, share in shares.items()) + " (last 200)", ""]
    for advice in advice_lines(status):
        lines += [f"**Advice**: {_plain(advice)}", ""]
    lines += [
        f"Active set **{_number(status.get('active'))}** of {_number(status.get('eligible'))} eligible samples; "
        f"{kinds['demonstration']} demonstrations, {kinds['evaluation']} evaluation trials, {kinds['failed']} failed",
        "",
        *_table(
            ("worker", "state", "reported", "last heard"),
            [
                (worker.name, worker.state, worker.trials, "" if worker.quiet_s is None else f"{worker.quiet_s:.0f} s")
                for worker in shown
            ],
        ),
        *([f"and {others} that left or were not heard for long"] if others else []),
        "",
        *_table(
            ("asked of the server", "median", "p99"),
            [(verb, f"{p50:.2f} ms", f"{p99:.2f} ms") for verb, (p50, p99) in sorted(latency_ms(status).items())],
        ),
        "",
        remark,
    ]
    return "\n".join(lines).rstrip()


def guide_page(task: str, description: str) -> str:
    """The page that explains the panels."""
    return f"**{_plain(task)}**: {_plain(description) or 'no description.'}\n\n{GUIDE}"


def outcomes_page(progress: Progress) -> str:
    """The page of how training trials ended."""
    rows = [(reason, count, percent(share), percent(lately)) for reason, count, share, lately in reason_rows(progress)]
    if not rows:
        return "No training trial yet."
    return "\n".join(_table(("how trials end", "count", "share", "last 50"), rows))


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    if not rows:
        return []
    cells = [[_plain(str(cell)) for cell in row] for row in rows]
    return [
        "| " + " | ".join(head) + " |",
        "|" + "|".join([":---", *["---:"] * (len(head) - 1)]) + "|",
        *("| " + " | ".join(row) + " |" for row in cells),
    ]


def _plain(text: str) -> str:
    """Text from elsewhere, with markdown's markup escaped."""
    return re.sub(r"([\\`*_{}\[\]<>()#|!~])", r"\\\1", printable(" ".join(text.split())))


def _number(value: object) -> str:
    return f"{value}" if isinstance(value, int | float) else "?"
