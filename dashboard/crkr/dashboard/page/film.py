"""The film of the best and the worst trial: shapes and their motion as data, which the page's own script draws."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from crkr.dashboard.page.markup import Element, card, number, tag
from crkr.protocol import Geom, Trace, printable

__all__ = ["Film", "Shown"]

SHORTEST_S: Final = 1.5  # of a motion on the screen; shorter ones are slowed down
SLOWER: Final = (1, 2, 5, 10, 20, 50)
RANGE_S: Final = 120.0  # a newer trial replaces one this much older, so that a live film stays current


@final
@dataclass(frozen=True, slots=True)
class Shown:
    """One trial of the film.

    Attributes:
        caption: A description in one line.
        success: Whether it succeeded.
        cost: In [0, 1]; 2 is worse than any cost.
        time: When it was played or received [s].
        trace: How things moved.
    """

    caption: str
    success: bool
    cost: float
    time: float
    trace: Trace


@final
@dataclass(slots=True)
class Film:
    """The best and the worst of the trials with a motion.

    Attributes:
        scene: The shapes.
        best: The successful trial of the lowest cost, or the trial of the lowest cost.
        worst: The failed trial of the highest cost, or the trial of the highest cost.
        version: Grows when either changes.
    """

    scene: tuple[Geom, ...] = ()
    best: Shown | None = None
    worst: Shown | None = None
    version: int = 0

    def add(self, caption: str, success: bool, cost: float | None, time: float, trace: Trace) -> None:
        """Consider a trial."""
        shown = Shown(caption, success, 2.0 if cost is None else cost, time, trace)
        before = self.best, self.worst
        if _is_due(self.best, time) or self.best is None or _rank(shown) < _rank(self.best):
            self.best = shown
        if _is_due(self.worst, time) or self.worst is None or _rank(shown) > _rank(self.worst):
            self.worst = shown
        self.version += before != (self.best, self.worst)

    def show(self, scene: Sequence[Geom]) -> None:
        """Set the shapes, once."""
        if not self.scene:
            self.scene = tuple(scene)
            self.version += 1

    def section(self) -> Element | None:
        """The two players; None without a scene or a motion."""
        if not self.scene or self.best is None:
            return None
        two = [("best trial", self.best)]
        if self.worst is not None and self.worst is not self.best:
            two.append(("worst trial", self.worst))
        players = [_player(place, title, shown) for place, (title, shown) in enumerate(two)]
        data = json.dumps({"scene": [_shape(geom) for geom in self.scene], "trials": [_motion(s) for _, s in two]})
        script = tag("script", type="application/json", id="film-data")
        script.text = data.replace("<", "\\u003c")
        pace = "In real time" if all(_slower(s) == 1 for _, s in two) else "Short motions are slowed down"
        note = f"{pace}. Drag to turn; scroll with Ctrl to come nearer."
        made = card("film", "Film", tag("div", *players, klass="players"), script, note=note)
        made.set("data-version", str(self.version))
        return made


def _is_due(shown: Shown | None, now: float) -> bool:
    return shown is not None and now - shown.time > RANGE_S


def _rank(shown: Shown) -> tuple[bool, float]:
    return not shown.success, shown.cost


def _slower(shown: Shown) -> int:
    """Slow-down factor of the playback."""
    lasts = float(shown.trace.time[-1] - shown.trace.time[0])
    return next((times for times in SLOWER if times * lasts >= SHORTEST_S), SLOWER[-1])


def _player(place: int, title: str, shown: Shown) -> Element:
    mark = tag("span", "success" if shown.success else "failure", klass=f"mark {'good' if shown.success else 'bad'}")
    end = float(shown.trace.time[-1] - shown.trace.time[0])
    return tag(
        "figure",
        tag("figcaption", tag("strong", title.capitalize()), mark, tag("span", shown.caption, klass="muted")),
        tag("canvas", klass="film", data_trial=place, aria_label=f"film of the {title}", role="img"),
        tag(
            "div",
            tag("button", "Pause", type="button", data_play=place),
            tag("input", type="range", min=0, max=1000, value=0, data_seek=place, aria_label="position in the film"),
            tag("output", f"{number(end, 2)} s", data_clock=place),
            klass="controls",
        ),
    )


def _shape(geom: Geom) -> dict[str, Any]:
    return {
        "body": printable(geom.body),
        "shape": geom.shape,
        "size": list(geom.size),
        "at": list(geom.position),
        "turn": list(geom.quaternion),
        "colour": [round(part, 3) for part in geom.colour],
    }


def _motion(shown: Shown) -> dict[str, Any]:
    trace = shown.trace
    poses = np.concatenate([trace.positions, trace.quaternions], axis=2)
    paths: Mapping[str, Any] = {printable(name): _packed(path) for name, path in trace.paths.items()}
    return {
        "time": (trace.time - trace.time[0]).round(4).tolist(),
        "bodies": [printable(name) for name in trace.bodies],
        "poses": _packed(poses),
        "paths": paths,
        "good": shown.success,
        "slower": _slower(shown),
    }


def _packed(values: Any) -> str:
    """Numbers as base64 of little-endian float32."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()
