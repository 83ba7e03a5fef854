"""A skill of a few lines, for tests: a point in the plane is to be reached; the goal is where the hand goes."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from crkr.protocol import Geom, Invalid, TaskSpec, Trace
from crkr.sim_worker.skill import Demonstration, Floats, SkillOptions, TrialResult

REACH = 0.35
REFUSED_BEYOND = 1.15


class Reaching:
    """The right goal is the state turned by 30 degrees; near it is a success, out of reach nothing is executed."""

    def __init__(self, options: SkillOptions) -> None:
        if options.preset not in (None, "plain", "small"):
            raise Invalid(f"reaching has presets plain and small; got {options.preset!r}")
        self._options = options
        self._state = np.zeros(2)

    @property
    def options(self) -> SkillOptions:
        return replace(self._options, environment=self._options.environment or "plane")

    def spec(self) -> TaskSpec:
        axes = [{"name": name, "unit": "m", "low": -1.0, "high": 1.0} for name in "xy"]
        goals = [{"name": name, "unit": "m", "low": -1.5, "high": 1.5} for name in "uv"]
        budget = 20 if self._options.preset == "small" else 250
        data = {"name": self._options.name or "reaching", "state": axes, "goal": goals, "budget": budget}
        return TaskSpec.from_dict({**data, "seed": self._options.seed})

    def reset(self, rng: np.random.Generator) -> Floats:
        self._state = rng.uniform(-1.0, 1.0, 2)
        return self._state.copy()

    def execute(self, goal: Floats) -> TrialResult:
        if np.hypot(*goal) > REFUSED_BEYOND * math.sqrt(2):
            return TrialResult(None, False, False, None, {"reason": "out of reach"}, None)
        distance = float(np.hypot(*(goal - right_goal(self._state))))
        marks = {"near": distance < REACH, "exact": distance < REACH / 4}
        info = {"reason": "reached" if marks["near"] else "missed", "outcomes": marks}
        path = np.linspace([0.0, 0.0, 0.0], [*goal, 0.0], 5)
        trace = Trace(
            np.linspace(0.0, 1.0, 5),
            ("hand",),
            path[:, None, :],
            np.tile([0.0, 0.0, 0.0, 1.0], (5, 1, 1)),
            {"hand": path},
        )
        return TrialResult(1.0 - math.exp(-distance), marks["near"], True, None, info, trace)

    def demonstrations(self, count: int, rng: np.random.Generator) -> Sequence[Demonstration]:
        found = []
        for _ in range(count):
            state = self.reset(rng)
            goal = right_goal(state)
            found.append(Demonstration(state, goal, self.execute(goal)))
        return found

    def best_plan(self, state: Floats) -> dict[str, bool]:
        """What a planner that knows the rotation gives."""
        self._state = state
        return dict(self.execute(right_goal(state)).info["outcomes"])

    def scene(self) -> Sequence[Geom]:
        return [Geom("world", "box", (1.0, 1.0, 0.01), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.5, 0.5, 0.5, 1.0))]


def right_goal(state: Floats) -> Floats:
    """(2,) state rotated by 30 degrees."""
    turn = math.radians(30.0)
    return np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ state


class Bare:
    """Reaching with the three methods that every skill has, and no more."""

    def __init__(self, options: SkillOptions) -> None:
        whole = Reaching(options)
        self.spec, self.reset, self.execute = whole.spec, whole.reset, whole.execute


class Fixed(Reaching):
    """Is judged in states on the x axis; its planner succeeds to the right."""

    def evaluation_context(self, number: int, rng: np.random.Generator) -> Floats:
        del rng  # Unused.
        self._state = np.array([1.0 if number % 2 else -1.0, 0.0])
        return self._state.copy()

    def best_plan(self, state: Floats) -> dict[str, bool]:
        return {"exact": bool(state[0] > 0)}


class Unmoved(Reaching):
    """Executes nothing, so that the model stays what the demonstrations made it."""

    def execute(self, goal: Floats) -> TrialResult:
        del goal  # Unused.
        return TrialResult(None, False, False, None, {"reason": "out of reach"}, None)


class Stuck(Reaching):
    """Simulates well for a while, then never returns."""

    def __init__(self, options: SkillOptions) -> None:
        super().__init__(options)
        self._left = 40

    def execute(self, goal: Floats) -> TrialResult:
        self._left -= 1
        if self._left < 0:
            threading.Event().wait()
        return super().execute(goal)


def make(options: SkillOptions) -> Reaching:
    return Reaching(options)


def make_bare(options: SkillOptions) -> Bare:
    return Bare(options)


def make_fixed(options: SkillOptions) -> Reaching:
    return Fixed(options)


def make_unmoved(options: SkillOptions) -> Reaching:
    return Unmoved(options)


def make_stuck(options: SkillOptions) -> Reaching:
    return Stuck(options)
