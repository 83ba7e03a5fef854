"""A skill of your own: a planar arm of two links learns which joint angles bring its hand to a point.

Start the service in another terminal, then, in this repository's folder, let two such arms learn:

    crkr server
    crkr workers examples.reach:make -n 2 --trials 400
    crkr evaluate reach --skill examples.reach:make --contexts 500

The learner knows nothing of links. The distance by which the hand missed is an outcome, so misses teach too.
"""

from collections.abc import Sequence

import numpy as np

from crkr.sim_worker.skill import Demonstration, Floats, Geom, SkillOptions, TaskSpec, Trace, TrialResult

UPPER, FORE = 0.5, 0.4  # lengths of the links [m]
NEAR = 0.02  # [m]
SPEC = {
    "name": "reach",
    "state": [
        {"name": "x", "unit": "m", "low": 0.3, "high": 0.7},
        {"name": "y", "unit": "m", "low": -0.3, "high": 0.3},
    ],
    "goal": [
        {"name": "shoulder", "unit": "rad", "low": -3.0, "high": 3.0},
        {"name": "elbow", "unit": "rad", "low": 0.0, "high": 2.8},
    ],
    "outcome": [
        {"name": "off_x", "unit": "m", "target": 0.0, "tolerance": 0.01, "group": "hand"},
        {"name": "off_y", "unit": "m", "target": 0.0, "tolerance": 0.01, "group": "hand"},
    ],
}


class Reach:
    """`spec`, `reset` and `execute` make a skill, the other methods are optional; see `crkr.sim_worker.skill`."""

    def __init__(self, options: SkillOptions) -> None:
        self._options = options
        self._point = np.zeros(2)

    def spec(self) -> TaskSpec:
        """The task, with the name and the seed that the command asks for."""
        return TaskSpec.from_dict({**SPEC, "name": self._options.name or "reach", "seed": self._options.seed})

    def reset(self, rng: np.random.Generator) -> Floats:
        """Draws a point to reach for."""
        self._point = rng.uniform([0.3, -0.3], [0.7, 0.3])
        return self._point.copy()

    def execute(self, goal: Floats) -> TrialResult:
        """Moves to the joint angles and measures the hand's position: replace this by your robot."""
        trace = swing(goal)
        off = trace.paths["hand"][-1, :2] - self._point
        distance = float(np.hypot(*off))
        success = distance < NEAR
        info = {"reason": "reached" if success else "missed"}
        return TrialResult(float(1 - np.exp(-distance / 0.1)), success, True, off, info, trace)

    def demonstrations(self, count: int, rng: np.random.Generator) -> Sequence[Demonstration]:
        """Optional: goals that work, here by the law of cosines; on a robot they are taught by hand."""
        shown = []
        for _ in range(count):
            x, y = state = self.reset(rng)
            elbow = np.arccos((x**2 + y**2 - UPPER**2 - FORE**2) / (2 * UPPER * FORE))
            shoulder = np.arctan2(y, x) - np.arctan2(FORE * np.sin(elbow), UPPER + FORE * np.cos(elbow))
            goal = np.array([shoulder, elbow])
            shown.append(Demonstration(state, goal, self.execute(goal)))
        return shown

    def scene(self) -> Sequence[Geom]:
        """Optional: the two links, for the viewer; their poses are in each trial's trace."""
        return [link("upper", UPPER), link("fore", FORE)]


def swing(goal: Floats) -> Trace:
    """From the stretched arm to the goal in a second."""
    time = np.linspace(0.0, 1.0, 25)
    first, second = time * goal[0], time * (goal[0] + goal[1])
    elbow = UPPER * along(first)
    return Trace(
        time,
        ("upper", "fore"),
        np.stack([np.zeros_like(elbow), elbow], axis=1),
        np.stack([about_z(first), about_z(second)], axis=1),
        {"hand": elbow + FORE * along(second)},
    )


def along(angle: Floats) -> Floats:
    """Unit vectors (n, 3) in the plane."""
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def about_z(angle: Floats) -> Floats:
    """Quaternions (n, 4), scalar last."""
    return np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=1)


def link(body: str, length: float) -> Geom:
    """A capsule along the body's x."""
    lying = (0.0, 0.5**0.5, 0.0, 0.5**0.5)
    return Geom(body, "capsule", (0.03, length / 2, 0.0), (length / 2, 0.0, 0.0), lying, (0.4, 0.6, 0.8, 1.0))


def make(options: SkillOptions) -> Reach:
    """Makes the skill; `crkr workers` calls this once in each process."""
    return Reach(options)
