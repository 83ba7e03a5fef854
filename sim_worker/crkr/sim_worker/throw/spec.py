"""The task specification of the throw."""

from __future__ import annotations

from typing import Final

from crkr.protocol import TaskSpec
from crkr.sim_worker.arm.dynamics import SPEED_LIMITS
from crkr.sim_worker.throw.layouts import Launcher
from crkr.sim_worker.throw.planner import POSTURE, RELEASE

__all__ = ["NAME", "task_spec"]

NAME: Final = "throw"
JOINTS: Final = ("shoulder_lift", "elbow", "wrist_1")
STATE: Final = ("bin_x", "bin_y", "wall_x", "wall_height")
PAN: Final = 0.6  # [rad]
REACH: Final = 0.7  # about the rest posture of a release [rad]
TIMES: Final = (0.3, 0.8)  # of the release after the start [s]
POSITION_SCALE: Final = 0.15  # [rad]
SPEED_SCALE: Final = 0.3  # [rad/s]
TIME_SCALE: Final = 0.05  # [s]
SPREADS: Final = 12.0**-0.5  # standard deviation of a uniform distribution over its width
LENGTHSCALE: Final = 3.0  # in standard deviations of the states

MISS_TOLERANCE: Final = 0.04  # [m]; the bin takes 0.14
OVER_WALL: Final = 0.05  # [m]; more is as good
OVER_WALL_TOLERANCE: Final = 0.02
SPARE_TIME: Final = 0.02  # [s]; more is as good
SPARE_TIME_TOLERANCE: Final = 0.01


def task_spec(launcher: Launcher, name: str | None = None, seed: int = 0) -> TaskSpec:
    """The specification for one launcher.

    Args:
        launcher: Its ranges are the states' box.
        name: Task name, "throw" if None.
        seed: Of the exploration draws.

    Raises:
        Invalid: The name or seed is bad.
    """
    state = [
        {"name": axis, "unit": "m", "low": low, "high": high, "lengthscale": LENGTHSCALE * SPREADS * (high - low)}
        for axis, low, high in zip(STATE, launcher.low, launcher.high, strict=True)
    ]
    goal = [
        {"name": "shoulder_pan", "unit": "rad", "low": -PAN, "high": PAN, "scale": POSITION_SCALE},
        *(
            {"name": joint, "unit": "rad", "low": rest - REACH, "high": rest + REACH, "scale": POSITION_SCALE}
            for joint, rest in zip(JOINTS, POSTURE.tolist(), strict=True)
        ),
        *(
            {"name": f"{joint}_speed", "unit": "rad/s", "low": 0.0, "high": limit, "scale": SPEED_SCALE}
            for joint, limit in zip(JOINTS, SPEED_LIMITS[RELEASE].tolist(), strict=True)
        ),
        {"name": "release_time", "unit": "s", "low": TIMES[0], "high": TIMES[1], "scale": TIME_SCALE},
    ]
    outcome = [
        *({"name": f"miss_{axis}", "unit": "m", "tolerance": MISS_TOLERANCE, "group": "miss"} for axis in "xy"),
        _at_least("over_wall", "m", OVER_WALL, OVER_WALL_TOLERANCE),
        _at_least("spare_time", "s", SPARE_TIME, SPARE_TIME_TOLERANCE),
    ]
    return TaskSpec.from_dict(
        {
            "name": name or NAME,
            "description": "Throw a ball over a wall into a bin. Cost: how far it passes bin and wall.",
            "seed": seed,
            "state": state,
            "goal": goal,
            "outcome": outcome,
            "kernel": {"linear_weight": 2.0},
            "noise_floor": 0.05,
            "budget": 100,
            "exploration": {"type": "outcome"},
            "prior_mean": "demonstrations",
        }
    )


def _at_least(name: str, unit: str, target: float, tolerance: float) -> dict[str, object]:
    return {"name": name, "unit": unit, "target": target, "tolerance": tolerance, "aim": "at_least"}
