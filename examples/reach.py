"""A skill of your own: a planar arm of two links learns which joint angles bring its hand to a point.

    crkr server                                                 # in another terminal
    crkr workers examples/reach.py:make -n 2 --trials 400
    crkr evaluate reach --contexts 500

The learner knows nothing of links. The distance by which the hand missed is an outcome, so misses teach too.
"""

import numpy as np

from crkr.sim_worker.skill import Chain, Floats, Geom, SkillOptions, TaskSpec, TrialResult

ARM = Chain({"upper": 0.5, "fore": 0.4}, target=0.02)  # lengths of the links, size of the point [m]
X, Y = (
    {"name": name, "unit": "m", "low": low, "high": high} for name, low, high in [("x", 0.3, 0.7), ("y", -0.3, 0.3)]
)
SHOULDER, ELBOW = (
    {"name": name, "unit": "rad", "low": low, "high": 3.0} for name, low in [("shoulder", -3), ("elbow", 0)]
)
OFF = [{"name": f"off_{axis}", "unit": "m", "tolerance": 0.01, "group": "hand"} for axis in "xy"]
SPEC = TaskSpec.from_dict({"name": "reach", "state": [X, Y], "goal": [SHOULDER, ELBOW], "outcome": OFF})


class Reach:
    """`spec`, `reset` and `execute` make a skill, all else is optional; see `crkr.sim_worker.skill`."""

    def __init__(self, options: SkillOptions) -> None:
        self._options, self._point = options, np.zeros(2)

    def spec(self) -> TaskSpec:
        """The task, with the name and the seed that the command asks for."""
        return self._options.applied_to(SPEC)

    def reset(self, rng: np.random.Generator) -> Floats:
        """Draws a point to reach for."""
        self._point = rng.uniform([0.3, -0.3], [0.7, 0.3])
        return self._point

    def execute(self, goal: Floats) -> TrialResult:
        """Moves to the joint angles in a second, and measures the hand's position: replace this by your robot."""
        time = np.linspace(0.0, 1.0, 25)
        points = ARM.points(time[:, None] * goal)
        off = points[-1, -1, :2] - self._point
        distance = np.hypot(*off)
        trace = ARM.trace(time, points, self._point)
        return TrialResult(1 - np.exp(-distance / 0.1), distance < 0.02, True, off, trace=trace)

    def scene(self) -> list[Geom]:
        """The shapes, for the viewer."""
        return ARM.scene()


make = Reach
