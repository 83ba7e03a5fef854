"""Charts as SVG for any width; colours come from the style sheet, so that they follow the reader's theme.

An element with a `data-tip` shows that text when it is pointed at or tapped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.dashboard.page.figures import Curve
from crkr.dashboard.page.markup import Element, label, number, tag
from crkr.protocol import Array, OutcomeEntry

__all__ = ["SMALL", "Axes", "Points", "Series", "histogram", "line_chart", "nice_ticks", "percent", "stacked_chart"]

COLOURS: Final = 8  # classes c0 to c7 of the style sheet
LEFT, RIGHT, TOP, BOTTOM = 54.0, 12.0, 10.0, 34.0
SMALL: Final = (230.0, 130.0)  # one of several charts side by side
TIPS: Final = 90  # columns of a chart with tips


def percent(share: float) -> str:
    """A share for people."""
    return f"{100 * share:.0f}\u202f%" if 0.0005 < share < 0.9995 else f"{100 * share:.4g}\u202f%"


def nice_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Round numbers within [low, high], at most `most` or one more."""
    if not high > low:
        return [low]
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next((factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw), 10 * power)
    first = math.ceil(low / step - 1e-9)
    return [round(place * step, 12) + 0.0 for place in range(first, math.floor(high / step + 1e-9) + 1)]


@final
@dataclass(frozen=True, slots=True)
class Axes:
    """Where numbers are on a chart."""

    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]
    left: float = LEFT

    def right(self, value: float) -> float:
        """Abscissa on the chart."""
        low, high = self.x
        return self.left + (value - low) / ((high - low) or 1.0) * (self.width - self.left - RIGHT)

    def down(self, value: float) -> float:
        """Ordinate on the chart."""
        low, high = self.y
        share = min(max((value - low) / ((high - low) or 1.0), 0.0), 1.0)
        return self.height - BOTTOM - share * (self.height - BOTTOM - TOP)

    def path(self, x: Array, y: Array) -> str:
        """A line through points as SVG writes it."""
        return "M" + "L".join(f"{self.right(a):.1f} {self.down(b):.1f}" for a, b in zip(x, y, strict=True))

    def frame(
        self, x_label: str, said: Callable[[float], str], y_ticks: Sequence[float] | None = None
    ) -> list[Element]:
        """Grid lines and the numbers beside them."""
        drawn = []
        for value in nice_ticks(*self.y) if y_ticks is None else y_ticks:
            level = self.down(value)
            drawn.append(tag("line", x1=self.left, x2=self.width - RIGHT, y1=level, y2=level, klass="grid"))
            drawn.append(tag("text", said(value), x=self.left - 6, y=level + 4, text_anchor="end"))
        base = self.height - BOTTOM
        drawn += self.abscissas(nice_ticks(*self.x, most=4), base + 15)
        drawn.append(tag("text", x_label, x=self.width - RIGHT, y=self.height - 4, text_anchor="end", klass="axis"))
        return drawn

    def abscissas(self, values: Sequence[float], down: float) -> list[Element]:
        """Numbers beneath the chart; one at the edge stays within."""
        drawn = []
        for value in values:
            at = self.right(value)
            anchor = "end" if at > self.width - RIGHT - 22 else "middle"
            place = min(at, self.width - 2) if anchor == "middle" else self.width - 2
            drawn.append(tag("text", number(value), x=place, y=down, text_anchor=anchor))
        return drawn

    def columns(self, x: Array, tips: Sequence[str]) -> list[Element]:
        """Invisible columns around abscissas, each with its text."""
        edges = np.concatenate([[x[0] - (x[1] - x[0]) / 2], (x[1:] + x[:-1]) / 2, x[-1:]]) if len(x) > 1 else self.x
        high = self.height - BOTTOM - TOP
        drawn = []
        for place, tip in enumerate(tips):
            left, right = self.right(max(edges[place], self.x[0])), self.right(edges[place + 1])
            drawn.append(tag("rect", x=left, width=max(right - left, 1.0), y=TOP, height=high, klass="hit", tip=tip))
        return drawn

    def drawing(self, title: str, *content: Element, klass: str = "") -> Element:
        """The chart; the title is for readers who cannot see it."""
        box = f"0 0 {self.width:.0f} {self.height:.0f}"
        return tag("svg", *content, view_box=box, role="img", aria_label=title, klass=f"chart {klass}".strip())


@final
@dataclass(frozen=True, slots=True)
class Series:
    """A curve with its name and the style sheet's number of its colour."""

    name: str
    curve: Curve
    colour: int


@final
@dataclass(frozen=True, slots=True)
class Points:
    """Single measurements with their intervals: (trials, value, low, high, tip) each."""

    name: str
    colour: int
    marks: tuple[tuple[float, float, float, float, str], ...]


def line_chart(
    title: str,
    series: Sequence[Series],
    points: Sequence[Points] = (),
    *,
    said: Callable[[float], str] = percent,
    size: tuple[float, float] = (560.0, 330.0),
    klass: str = "",
) -> Element:
    """Curves with their bands, and single measurements, over [0, 1]."""
    last = max([each.curve.trials[-1] for each in series] + [mark[0] for each in points for mark in each.marks] + [1.0])
    axes = Axes(*size, (0.0, float(last)), (0.0, 1.0))
    drawn = axes.frame("training trials", said, (0.0, 0.25, 0.5, 0.75, 1.0))
    for each in series:
        curve, colour = each.curve, f"c{each.colour % COLOURS}"
        band = axes.path(np.append(curve.trials, curve.trials[::-1]), np.append(curve.high, curve.low[::-1]))
        drawn.append(tag("path", d=band + "Z", klass=f"band {colour}"))
        drawn.append(tag("path", d=axes.path(curve.trials, curve.value), klass=f"line {colour}"))
    if series:
        drawn += axes.columns(*_tips(series, said))
    for group in points:
        for trials, value, low, high, tip in group.marks:
            x, colour = axes.right(trials), f"c{group.colour % COLOURS}"
            drawn.append(tag("line", x1=x, x2=x, y1=axes.down(low), y2=axes.down(high), klass=f"whisker {colour}"))
            drawn.append(tag("circle", cx=x, cy=axes.down(value), r=3.2, klass=f"dot {colour}", tip=tip))
    return axes.drawing(title, *drawn, klass=klass)


def _tips(series: Sequence[Series], said: Callable[[float], str]) -> tuple[Array, list[str]]:
    """Abscissas of the longest curve, at most `TIPS`, and their tips."""
    longest = max((each.curve for each in series), key=lambda curve: len(curve.trials))
    shown = longest.trials[:: -(-len(longest.trials) // TIPS)]
    texts = []
    for trials in shown:
        lines = []
        for each in series:
            place = int(np.abs(each.curve.trials - trials).argmin())
            value, low, high = (float(part[place]) for part in (each.curve.value, each.curve.low, each.curve.high))
            count = number(each.curve.count[place])
            lines.append(f"{each.name}: {said(value)} ({said(low)} to {said(high)}) of {count}")
        texts.append("\n".join([f"up to trial {number(trials)}", *lines]))
    return shown, texts


def stacked_chart(title: str, trials: Array, shares: Sequence[tuple[str, Array, str]]) -> Element:
    """Shares that add up to 1 over the run: (name, (n,) shares, class of the colour) from the bottom up."""
    axes = Axes(430.0, 190.0, (0.0, float(trials[-1])), (0.0, 1.0))
    base, drawn = np.zeros(len(trials)), []
    for _, share, colour in shares:
        top = base + share
        outline = axes.path(np.append(trials, trials[::-1]), np.append(top, base[::-1]))
        drawn.append(tag("path", d=outline + "Z", klass=f"area {colour}"))
        base = top
    stride = -(-len(trials) // TIPS)
    tips = [
        "\n".join(
            [f"up to trial {number(trials[place])}"]
            + [f"{name}: {percent(share[place])}" for name, share, _ in reversed(shares) if share[place] > 0]
        )
        for place in range(0, len(trials), stride)
    ]
    return axes.drawing(
        title, *drawn, *axes.frame("training trials", percent, (0.0, 0.5, 1.0)), *axes.columns(trials[::stride], tips)
    )


def histogram(axis: OutcomeEntry, values: Array) -> Element:
    """Histogram of measured numbers (n,) around their target, with the tolerated range."""
    low, high = _range(axis, values)
    counts, edges = np.histogram(np.clip(values, low, high), bins=31, range=(low, high))
    axes = Axes(*SMALL, (low, high), (0.0, float(counts.max()) or 1.0), left=RIGHT)
    good = (
        low if axis.aim == "at_most" else axis.target - axis.tolerance,
        high if axis.aim == "at_least" else axis.target + axis.tolerance,
    )
    left, right = axes.right(max(good[0], low)), axes.right(min(good[1], high))
    bottom = SMALL[1] - BOTTOM
    drawn = [tag("rect", x=left, width=max(right - left, 1.0), y=TOP, height=bottom - TOP, klass="good")]
    for count, start, end in zip(counts, edges, edges[1:], strict=False):
        x, level = axes.right(start), axes.down(float(count))
        tip = f"{number(start)} to {number(end)} {axis.unit}: {count} trials"
        wide, tall = axes.right(end) - x - 0.6, bottom - level
        drawn.append(tag("rect", x=x + 0.3, y=level, width=wide, height=tall, klass="bar", tip=tip))
    middle = axes.right(axis.target)
    drawn.append(tag("line", x1=middle, x2=middle, y1=TOP, y2=bottom, klass="target"))
    drawn += axes.abscissas(nice_ticks(low, high, most=4), bottom + 15)
    drawn.append(
        tag("text", label(axis.name, axis.unit), x=SMALL[0] - RIGHT, y=SMALL[1] - 4, text_anchor="end", klass="axis")
    )
    return axes.drawing(f"outcome {axis.name}", *drawn, klass="small")


def _range(axis: OutcomeEntry, values: Array) -> tuple[float, float]:
    """The range that a histogram shows: nearly all values, and the target with its tolerance."""
    if axis.aim == "equal":
        spread = float(np.quantile(np.abs(values - axis.target), 0.98))
        reach = max(spread, 1.5 * axis.tolerance) or 1.0
        return axis.target - reach, axis.target + reach
    low, high = (float(end) for end in np.quantile(values, [0.01, 0.99]))
    low, high = min(low, axis.target - 2 * axis.tolerance), max(high, axis.target + 2 * axis.tolerance)
    return (low, high) if low < high else (low - 1.0, high + 1.0)
