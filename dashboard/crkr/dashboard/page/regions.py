"""Where trials fail: maps of two coordinates of the state, slices of one, and the worst region in words."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.client.tally import wilson_interval
from crkr.dashboard.page.charts import BOTTOM, LEFT, RIGHT, SMALL, TOP, Axes, nice_ticks, percent
from crkr.dashboard.page.markup import Element, label, number, tag
from crkr.protocol import Array, StateDimension

__all__ = ["Region", "ordered", "pairs", "slice_chart", "state_map", "worst_region"]

Flags = NDArray[np.bool_]

CELLS: Final = 9  # of a map, each way
SLICES: Final = 8
MAPPED: Final = 5  # coordinates of which maps of pairs are drawn
LEVELS: Final = 10  # classes h0 to h10 of the style sheet
LEAST: Final = 20  # trials in a region that is worth a sentence
CLEAR: Final = 3.0  # standard errors


@final
@dataclass(frozen=True, slots=True)
class Region:
    """A range of states where trials succeed clearly less often than elsewhere.

    Attributes:
        axis: The coordinate that defines it.
        low: Its lower end, or None.
        high: Its upper end, or None.
        inside: Share of successful trials there.
        elsewhere: Share of successful trials in the rest.
        count: Trials there.
    """

    axis: StateDimension
    low: float | None
    high: float | None
    inside: float
    elsewhere: float
    count: int

    def __str__(self) -> str:
        where = f"below {number(self.high, 2)}" if self.low is None and self.high is not None else ""
        where = f"above {number(self.low, 2)}" if self.high is None and self.low is not None else where
        unit = f" {self.axis.unit}" if self.axis.unit else ""
        return (
            f"It fails most where {self.axis.name} is {where}{unit}: {percent(self.inside)} of {number(self.count)} "
            f"trials succeed there, {percent(self.elsewhere)} elsewhere."
        )


def ordered(axes: tuple[StateDimension, ...], states: Array, success: Flags) -> list[int]:
    """Coordinates that vary, those first along which success varies most beyond chance."""
    varied = [place for place, axis in enumerate(axes) if np.ptp(states[:, place]) > 1e-6 * (axis.high - axis.low)]
    return sorted(varied, key=lambda place: -_variation(axes[place], states[:, place], success))


def _variation(axis: StateDimension, values: Array, success: Flags) -> float:
    counts, met = _sliced(axis, values, success)
    rate = success.mean() if len(success) else 0.0
    spread = max(rate * (1 - rate), 1e-9)
    return float(((met - counts * rate) ** 2 / np.maximum(counts * spread, 1e-9))[counts > 0].sum())


def _places(axis: StateDimension, values: Array, cells: int) -> NDArray[np.int64]:
    """Cell of each value within the axis's box; values outside count in the outermost cells."""
    share = (values - axis.low) / (axis.high - axis.low)
    return np.asarray(np.clip((share * cells).astype(int), 0, cells - 1))


def _sliced(axis: StateDimension, values: Array, success: Flags) -> tuple[Array, Array]:
    places = _places(axis, values, SLICES)
    counts = np.bincount(places, minlength=SLICES).astype(float)
    return counts, np.bincount(places, weights=success, minlength=SLICES).astype(float)


def worst_region(axes: tuple[StateDimension, ...], states: Array, success: Flags) -> Region | None:
    """The end of one coordinate's range where trials succeed least, if it is significant."""
    found: list[tuple[float, Region]] = []
    for place, axis in enumerate(axes):
        counts, met = _sliced(axis, states[:, place], success)
        edges = np.linspace(axis.low, axis.high, SLICES + 1)
        for cut in range(1, SLICES):
            for inside in (slice(0, cut), slice(cut, SLICES)):
                count, good = float(counts[inside].sum()), float(met[inside].sum())
                rest, rest_good = float(counts.sum()) - count, float(met.sum()) - good
                if min(count, rest) < LEAST:
                    continue
                rate = float(met.sum() / counts.sum())
                error = np.sqrt(rate * (1 - rate) * (1 / count + 1 / rest)) or 1.0
                score = (rest_good / rest - good / count) / error
                low, high = (None, float(edges[cut])) if inside.start == 0 else (float(edges[cut]), None)
                found.append((float(score), Region(axis, low, high, good / count, rest_good / rest, int(count))))
    score, region = max(found, key=lambda each: each[0], default=(0.0, None))
    return region if score > CLEAR else None


def slice_chart(axis: StateDimension, values: Array, success: Flags) -> Element:
    """Share of successful trials along one coordinate, with 95 % intervals."""
    frame = Axes(*SMALL, (axis.low, axis.high), (0.0, 1.0), left=46.0)
    counts, met = _sliced(axis, values, success)
    edges = np.linspace(axis.low, axis.high, SLICES + 1)
    drawn = frame.frame(label(axis.name, axis.unit), percent, (0.0, 0.5, 1.0))
    for count, good, start, end in zip(counts, met, edges, edges[1:], strict=False):
        if not count:
            continue
        low, high = wilson_interval(int(good), int(count))
        x, wide = frame.right(start) + 1, frame.right(end) - frame.right(start) - 2
        tip = _told(f"{number(start)} to {number(end)}", int(good), int(count))
        tall = frame.down(low) - frame.down(high)
        drawn.append(tag("rect", x=x, width=wide, y=frame.down(high), height=tall, klass="range", tip=tip))
        level = frame.down(good / count)
        drawn.append(tag("line", x1=x, x2=x + wide, y1=level, y2=level, klass=f"level h{_level(good / count)}"))
    return frame.drawing(f"success along {axis.name}", *drawn, klass="small")


def pairs(order: list[int]) -> list[tuple[int, int]]:
    """Pairs of coordinates that maps are drawn of, the most telling first."""
    return sorted(combinations(order[:MAPPED], 2), key=lambda pair: order.index(pair[0]) + order.index(pair[1]))


def state_map(axes: tuple[StateDimension, StateDimension], states: Array, success: Flags) -> Element:
    """Share of successful trials over two coordinates; states (n, 2). A small square means few trials."""
    width, height = 420.0, 360.0
    across, up = axes
    frame = Axes(width, height, (across.low, across.high), (up.low, up.high))
    cell = _places(across, states[:, 0], CELLS) * CELLS + _places(up, states[:, 1], CELLS)
    counts = np.bincount(cell, minlength=CELLS * CELLS).reshape(CELLS, CELLS)
    met = np.bincount(cell, weights=success, minlength=CELLS * CELLS).reshape(CELLS, CELLS)
    usual = float(np.quantile(counts[counts > 0], 0.5)) if counts.any() else 1.0
    wide, tall = (width - LEFT - RIGHT) / CELLS, (height - TOP - BOTTOM) / CELLS
    edges = [np.linspace(axis.low, axis.high, CELLS + 1) for axis in axes]
    drawn = [tag("rect", x=LEFT, y=TOP, width=width - LEFT - RIGHT, height=height - TOP - BOTTOM, klass="ground")]
    for column, row in np.argwhere(counts):
        count, good = int(counts[column, row]), int(met[column, row])
        size = 0.25 + 0.71 * min(1.0, np.sqrt(count / usual))
        x = LEFT + (column + 0.5 - size / 2) * wide
        y = height - BOTTOM - (row + 0.5 + size / 2) * tall
        spans = [
            f"{axis.name} {number(edge[place])} to {number(edge[place + 1])} {axis.unit}".strip()
            for axis, edge, place in zip(axes, edges, (column, row), strict=True)
        ]
        tip = _told("\n".join(spans), good, count)
        box = {"x": x, "y": y, "width": size * wide, "height": size * tall}
        drawn.append(tag("rect", rx=2, klass=f"cell h{_level(good / count)}", tip=tip, **box))
    base = height - BOTTOM
    drawn += frame.abscissas(nice_ticks(*frame.x, most=4), base + 15)
    for value in nice_ticks(*frame.y, most=4):
        drawn.append(tag("text", number(value), x=LEFT - 6, y=frame.down(value) + 4, text_anchor="end"))
    named = label(across.name, across.unit), label(up.name, up.unit)
    drawn.append(tag("text", f"{named[0]} \u2192", x=width - RIGHT, y=height - 4, text_anchor="end", klass="axis"))
    middle = (TOP + base) / 2
    turned = {"transform": f"rotate(-90 12 {middle})", "text_anchor": "middle"}
    drawn.append(tag("text", f"{named[1]} \u2192", x=12, y=middle, klass="axis", **turned))
    return frame.drawing(f"success over {across.name} and {up.name}", *drawn, klass="map")


def _level(share: float) -> int:
    return round(share * LEVELS)


def _told(where: str, good: int, count: int) -> str:
    low, high = wilson_interval(good, count)
    return f"{where}\n{percent(good / count)} of {number(count)} succeed ({percent(low)} to {percent(high)})"
