"""The sections of a page with charts, made from the figures of a run."""

from __future__ import annotations

from typing import Any, Final

from crkr.dashboard.page.charts import Points, Series, histogram, line_chart, percent, stacked_chart
from crkr.dashboard.page.figures import KEPT, Figures
from crkr.dashboard.page.markup import Element, card, number, table, tag
from crkr.dashboard.page.regions import ordered, pairs, slice_chart, state_map, worst_region
from crkr.dashboard.status_facts import reason_rows

__all__ = ["costs", "outcomes", "reasons", "regions", "success", "summary"]

SHOWN_REASONS: Final = 6
SHOWN_OUTCOMES: Final = 12
SHOWN_SLICES: Final = 12
LEAST: Final = 30  # least trials for maps of states


def summary(figures: Figures) -> Element:
    """The result in a sentence or two."""
    progress = figures.progress
    if not progress.trials:
        return tag("p", "No training trial yet.", klass="lead")
    name = _judged(figures)
    curve = figures.success(name) if name else None
    if curve is None or not len(curve.trials):
        return tag("p", f"{number(progress.trials)} trials, none judged.", klass="lead")
    now, low, high = (float(part[-1]) for part in (curve.value, curve.low, curve.high))
    count = number(curve.count[-1])
    which = f", by the criterion {name}" if len(progress.criteria) > 1 else ""
    interval = f"95\u202f% interval {percent(low)} to {percent(high)}"
    said = f"{percent(now)} of the last {count} trials succeed{which} ({interval})"
    first = float(curve.value[0])
    trend = f", {percent(first)} at the beginning" if len(curve.trials) > 1 else ""
    region = _worst(figures)
    return tag("p", tag("strong", said), f"{trend}. ", str(region) if region else None, klass="lead")


def _judged(figures: Figures) -> str | None:
    """The criterion of the summary: the last and strictest one."""
    return figures.progress.criteria[-1] if figures.progress.criteria else None


def _worst(figures: Figures) -> Any:
    newest = figures.newest
    return worst_region(figures.spec.state, newest.states, newest.success) if len(newest) >= LEAST else None


def success(figures: Figures) -> Element:
    """Success over trials, of training and of evaluations."""
    progress = figures.progress
    series = [Series(name, figures.success(name), place) for place, name in enumerate(progress.criteria)]
    series = [each for each in series if len(each.curve.trials)]
    points = []
    results = sorted(progress.epochs.values(), key=lambda result: result.epoch)
    results = results[:: -(-len(results) // 60) or 1]
    for place, name in enumerate(progress.criteria):
        marks = []
        for result in results:
            if result.tally.judged[name]:
                low, high = result.tally.interval(name)
                rate = result.tally.rate(name)
                tip = f"evaluation {result.epoch}\n{name}: {percent(rate)} ({percent(low)} to {percent(high)})"
                marks.append((float(result.trial), rate, low, high, tip))
        if marks:
            points.append(Points(name, place, tuple(marks)))
    if not (series or points):
        return card("success", "Success over trials", _empty("no trial yet"), klass="wide")
    names = [(name, f"c{place % 8}") for place, name in enumerate(progress.criteria)]
    window = number(series[0].curve.count[-1]) if series else "50"
    note = f"Lines: training trials, {window} at a time. "
    note += "Dots: evaluations of the policy without exploration. " if points else ""
    note += "Bands and bars: 95 % intervals."
    return card(
        "success", "Success over trials", _legend(names), line_chart("success", series, points), note=note, klass="wide"
    )


def reasons(figures: Figures) -> Element:
    """How trials end."""
    rows = reason_rows(figures.progress)
    if not rows:
        return card("reasons", "How trials end", _empty("no trial yet"))
    trials, shares = figures.reasons()
    kept = list(shares.items())[:SHOWN_REASONS]
    colours = {name: f"r{place}" for place, (name, _) in enumerate(kept)}
    cells = [
        (
            tag("span", tag("i", klass=f"key {colours[name]}"), name),
            number(count),
            percent(share),
            percent(lately),
        )
        for name, count, share, lately in rows
        if name in colours
    ]
    chart = stacked_chart("how trials end", trials, [(name, share, colours[name]) for name, share in kept])
    rest = len(rows) - len(cells)
    more = tag("p", f"and {number(rest)} rarer {'ending' if rest == 1 else 'endings'}", klass="muted") if rest else None
    listed = table(("reason", "trials", "share", "last 50"), cells, klass="numbers")
    return card("reasons", "How trials end", chart, listed, more)


def regions(figures: Figures) -> Element:
    """Where in the space of states trials fail."""
    title, newest, spec = "Where it fails", figures.newest, figures.spec
    if len(newest) < LEAST:
        return card("regions", title, _empty(f"after {LEAST} training trials"), klass="full")
    states, flags = newest.states, newest.success
    order = ordered(spec.state, states, flags)
    drawn: list[Element] = []
    two = pairs(order)
    if two:
        options = [
            tag("option", f"{spec.state[a].name} and {spec.state[b].name}", value=f"map-{a}-{b}") for a, b in two
        ]
        maps = [
            tag(
                "div",
                state_map((spec.state[a], spec.state[b]), states[:, [a, b]], flags),
                id=f"map-{a}-{b}",
                hidden=place > 0,
                klass="choice",
            )
            for place, (a, b) in enumerate(two)
        ]
        chooser = tag("label", "Map of ", tag("select", *options, id="map-choice", data_choice="map"), klass="chooser")
        drawn.append(tag("div", chooser, *maps, _scale(), klass="maps"))
    slices = [slice_chart(spec.state[place], states[:, place], flags) for place in order[:SHOWN_SLICES]]
    drawn.append(tag("div", *slices, klass="slices"))
    told = f"The last {number(len(newest))} training trials" if len(newest) == KEPT else "All training trials"
    region = _worst(figures)
    note = f"{told}. {region or 'No end of any coordinate is clearly worse than the rest.'}"
    return card("regions", title, tag("div", *drawn, klass="split"), note=note, klass="full")


def _scale() -> Element:
    steps = [tag("i", klass=f"key h{level}") for level in range(11)]
    return tag("p", "0\u202f% succeed ", *steps, " 100\u202f%. Small squares: few trials.", klass="scale")


def outcomes(figures: Figures) -> Element | None:
    """Outcomes around their targets; None where the task measures none."""
    spec, newest = figures.spec, figures.newest
    drawn = []
    for place, axis in list(enumerate(spec.outcome))[:SHOWN_OUTCOMES]:
        values = newest.outcomes[:, place]
        values = values[values == values]  # without NaN
        if len(values):
            drawn.append(histogram(axis, values))
    if not spec.outcome:
        return None
    note = "Of the newest training trials. Shaded: within tolerance of the target. The outermost bars hold all beyond."
    content = tag("div", *drawn, klass="slices") if drawn else _empty("nothing measured yet")
    return card("outcomes", "Measured outcomes", content, note=note, klass="full")


def costs(figures: Figures) -> Element:
    """Cost over trials."""
    curve = figures.cost()
    if not len(curve.trials):
        return card("costs", "Cost over trials", _empty("no cost yet"))
    median = [Series("median cost", curve, 4)]
    chart = line_chart("cost", median, said=lambda value: number(value, 2), size=(380.0, 250.0), klass="small")
    return card("costs", "Cost over trials", chart, note="Median, and the range of the middle four fifths; 0 is best.")


def _legend(names: list[tuple[str, str]]) -> Element:
    return tag("p", *(tag("span", tag("i", klass=f"key {colour}"), name) for name, colour in names), klass="legend")


def _empty(text: str) -> Element:
    return tag("p", text.capitalize() + ".", klass="empty")
