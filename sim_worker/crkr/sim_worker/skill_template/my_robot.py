"""A skill: my_robot throws a ball at a mark on the floor, at a distance that differs each time.

    crkr server                                                  # in another terminal
    crkr workers my_robot.py:make -n 2 --trials 300
    crkr evaluate my-robot

Replace `execute` by your robot or simulator; the specification is my_robot.toml.
"""

from pathlib import Path

import numpy as np

from crkr.sim_worker.skill import Floats, Geom, SkillOptions, TaskSpec, Trace, TrialResult, read_specification

GRAVITY = 9.81  # [m/s^2]
NEAR = 0.1  # [m]


class MyRobot:
    """`spec`, `reset` and `execute` make a skill, `scene` is for displays; `crkr.sim_worker.skill` names the rest."""

    def __init__(self, options: SkillOptions) -> None:
        self._spec = options.applied_to(read_specification(Path(__file__).with_suffix(".toml")))
        self._distance = 0.0

    def spec(self) -> TaskSpec:
        """The specification file beside this one, with the command's name and seed."""
        return self._spec

    def reset(self, rng: np.random.Generator) -> Floats:
        """A new situation (d,): draw it, or measure it."""
        self._distance = rng.uniform(1.0, 4.0)
        return np.array([self._distance])

    def restore(self, state: Floats) -> None:
        """Sets up a stored state (d,), so that films show stored trials; delete it if that is impossible."""
        self._distance = float(state[0])

    def execute(self, goal: Floats) -> TrialResult:
        """Tries a goal (p,) and measures the result."""
        speed, angle = goal
        flight = 2 * speed * np.sin(angle) / GRAVITY  # [s]
        time = np.linspace(0.0, flight, 20)
        path = np.stack(
            [speed * np.cos(angle) * time, 0 * time, speed * np.sin(angle) * time - GRAVITY / 2 * time**2], axis=1
        )
        too_far = path[-1, 0] - self._distance  # signed: it says which way to correct
        hit = abs(too_far) < NEAR
        return TrialResult(
            cost=0.1 if hit else 1 - 0.9 * np.exp(-abs(too_far)),
            success=bool(hit),
            executed=True,  # False for a goal that cannot be tried, with cost None
            outcome=np.array([too_far]),
            info={"reason": "hit" if hit else "too far" if too_far > 0 else "too short"},
            trace=self._trace(time, path),
        )

    def scene(self) -> list[Geom]:
        """Shapes of the bodies that a trace moves."""
        return [
            Geom("ball", "sphere", (0.05, 0.0, 0.0), colour=(0.9, 0.5, 0.1, 1.0)),
            Geom("mark", "box", (NEAR, 0.3, 0.01), colour=(0.2, 0.6, 0.3, 1.0)),
        ]

    def _trace(self, time: Floats, path: Floats) -> Trace:
        """Poses of ball and mark: positions (n, 2, 3) [m] and rotations (n, 2, 4), scalar last."""
        mark = np.broadcast_to([self._distance, 0.0, 0.0], path.shape)
        upright = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(time), 2, 4))
        return Trace(time, ("ball", "mark"), np.stack([path, mark], axis=1), upright, {"ball": path})


make = MyRobot
