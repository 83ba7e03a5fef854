"""Measurements of a benchmark, their table, and calls timed in turns, so that other load affects all equally."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from crkr.client.cli.console import print_json, print_table
from crkr.protocol import Array

__all__ = ["Measurement", "in_turns", "p50", "p99", "ratio", "show", "timed"]


@final
@dataclass(frozen=True, slots=True)
class Measurement:
    """One row of the table.

    Attributes:
        what: What was measured.
        value: The ratio, or another number.
        bar: What it should reach; None: shown for comparison only.
        at_least: The value should be at least the bar, rather than at most.
        behind: The numbers it comes from, by name with unit.
    """

    what: str
    value: float
    bar: float | None = None
    at_least: bool = False
    behind: Mapping[str, float] = field(default_factory=dict)

    @property
    def reached(self) -> bool:
        """Whether the value reaches its bar."""
        return self.bar is None or (self.value >= self.bar if self.at_least else self.value <= self.bar)


def ratio(
    what: str,
    numbers: Mapping[str, float],
    above: str,
    below: str,
    bar: float | None = None,
    *,
    at_least: bool = False,
    unit: str = "us",
) -> Measurement:
    """The measurement `above` / `below`, two of the numbers, with both behind it."""
    behind = {f"{name} {unit}": numbers[name] for name in (above, below)}
    return Measurement(what, numbers[above] / numbers[below], bar, at_least, behind)


def show(found: Iterable[Measurement], title: str, as_json: bool, details: str = "behind") -> None:
    """Print measurements as one JSON value, with the numbers behind them under the key `details`, or as a table."""
    if as_json:
        print_json(
            [
                {
                    "what": one.what,
                    "value": one.value,
                    "bar": one.bar,
                    "at_least": one.at_least,
                    details: dict(one.behind),
                    "reached": one.reached,
                }
                for one in found
            ]
        )
        return
    rows = []
    for one in found:
        bar = "" if one.bar is None else f"{'>=' if one.at_least else '<='} {one.bar:.3g}"
        mark = "" if one.bar is None else "reached" if one.reached else "NOT REACHED"
        behind = ", ".join(f"{name} {number:.4g}" for name, number in one.behind.items())
        rows.append((one.what, f"{one.value:.3g}", bar, mark, behind))
    print_table(("what", "figure", "bar", "", "behind it"), rows, title)


def p50(times: Array) -> float:
    """Median of times [s] in [us]."""
    return float(np.percentile(times, 50) * 1e6)


def p99(times: Array) -> float:
    """99th percentile of times [s] in [us]."""
    return float(np.percentile(times, 99) * 1e6)


def timed(call: Callable[[], Any], count: int, clock: Callable[[], float] = time.perf_counter) -> Array:
    """(count,) times of consecutive calls [s]."""
    times = np.empty(count)
    for index in range(count):
        started = clock()
        call()
        times[index] = clock() - started
    return times


def in_turns(
    calls: Mapping[str, Callable[[], Any]],
    rounds: int,
    count: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, Array]:
    """Name -> (rounds * count,) times [s]: each round times `count` calls of each, after up to 20 untimed ones."""
    for call in calls.values():
        timed(call, min(count, 20))
    found: dict[str, list[Array]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            found[name].append(timed(call, count, clock))
    return {name: np.concatenate(times) for name, times in found.items()}
