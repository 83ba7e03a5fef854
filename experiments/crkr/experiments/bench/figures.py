"""What a bench prints: ratios beside their bars, and the times behind them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

import numpy as np

from crkr.client.cli.console import print_json, print_table
from crkr.protocol import Array

__all__ = ["Figure", "p50", "p99", "show"]


@final
@dataclass(frozen=True, slots=True)
class Figure:
    """One line of the table.

    Attributes:
        what: What was measured.
        value: The ratio.
        bar: What it should reach; None: shown for comparison only.
        at_least: The ratio should be at least the bar, rather than at most.
        behind: The figures it comes from, by name with unit.
    """

    what: str
    value: float
    bar: float | None
    at_least: bool
    behind: dict[str, float]

    @property
    def reached(self) -> bool:
        """Whether the ratio reaches its bar."""
        return self.bar is None or (self.value >= self.bar if self.at_least else self.value <= self.bar)


def p50(times: Array) -> float:
    """Median of times [s] in [us]."""
    return float(np.percentile(times, 50) * 1e6)


def p99(times: Array) -> float:
    """99th percentile of times [s] in [us]."""
    return float(np.percentile(times, 99) * 1e6)


def show(figures: Iterable[Figure], title: str, as_json: bool) -> None:
    """Prints them as one JSON value, or as a table."""
    if as_json:
        print_json(
            [
                {
                    "what": one.what,
                    "value": one.value,
                    "bar": one.bar,
                    "at_least": one.at_least,
                    "behind": one.behind,
                    "reached": one.reached,
                }
                for one in figures
            ]
        )
        return
    rows = []
    for one in figures:
        bar = "" if one.bar is None else f"{'>=' if one.at_least else '<='} {one.bar:g}"
        mark = "" if one.bar is None else "reached" if one.reached else "NOT REACHED"
        behind = ", ".join(f"{name} {number:.4g}" for name, number in one.behind.items())
        rows.append((one.what, f"{one.value:.3g}", bar, mark, behind))
    print_table(("what", "ratio", "bar", "", "behind it"), rows, title)
