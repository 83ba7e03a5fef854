"""The task specification of table tennis, in the presets `tuned` and `paper`."""

from __future__ import annotations

from typing import Any, Final

from crkr.protocol import Invalid, TaskSpec
from crkr.sim_worker.arm.dynamics import SPEED_LIMITS
from crkr.sim_worker.table_tennis.ball.launchers import Launcher
from crkr.sim_worker.table_tennis.planner import HOME

__all__ = ["NAME", "PRESETS", "task_spec"]

NAME: Final = "table-tennis"
PRESETS: Final = ("tuned", "paper")

JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
POSITION_LIMITS: Final = (6.2832, 6.2832, 3.1416, 6.2832, 6.2832, 6.2832)  # [rad], as in scene.xml
HIT_TIMES: Final = (0.2, 1.0)  # [s] after the snapshot
# About the spread of good goals over the nominal launcher.
POSITION_SCALE: Final = 0.15  # [rad]
SPEED_SCALE: Final = 0.4  # [rad/s]
TIME_SCALE: Final = 0.03  # [s]

STATE: Final = (
    ("ball_x", "m"),
    ("ball_y", "m"),
    ("ball_z", "m"),
    ("ball_vx", "m/s"),
    ("ball_vy", "m/s"),
    ("ball_vz", "m/s"),
)
BOX: Final = 2.5  # half the described state box, in standard deviations of the launcher's snapshots
LENGTHSCALES: Final = {"tuned": 3.0, "paper": 10.0}  # in the same unit; without a linear term it must reach further

HIT_TOLERANCE: Final = 0.03  # [m]
LANDING_TOLERANCE: Final = 0.3  # [m]
SPARE_TIME: Final = 0.02  # [s]; more is as good
SPARE_TIME_TOLERANCE: Final = 0.01  # [s]
CLEARANCE: Final = 0.03  # of the arm to the table [m]; more is as good, and 1 cm is refused
CLEARANCE_TOLERANCE: Final = 0.01  # [m]
REACH: Final = 1.2  # about the rest posture in which good strokes are [rad]

COST: Final = "Cost: how far the ball passes the paddle's centre at the hit time; 0.28 at 2 cm, 0.88 at 5 cm."

LEARNING: Final[dict[str, dict[str, Any]]] = {
    "tuned": {
        "description": f"Return a table tennis ball; the settings that learn best. {COST}",
        "kernel": {"linear_weight": 2.0},
        # A cost near zero means that this ball was hit, not that the goal is exact for similar balls.
        "noise_floor": 0.05,
        # Successes are many and good: a larger budget costs time and brings nothing.
        "budget": 100,
        "exploration": {"type": "outcome"},
        "prior_mean": "demonstrations",
    },
    "paper": {
        "description": f"Return a table tennis ball; the settings of the paper. {COST}",
        # Around a zero mean, goals of up to ten scales are drawn from this prior.
        "kernel": {"signal_variance": 25.0},
        "exploration": {"type": "gaussian"},
        "prior_mean": "zero",
    },
}


def task_spec(launcher: Launcher, preset: str, name: str | None = None, seed: int = 0) -> TaskSpec:
    """The specification for one launcher.

    Args:
        launcher: Its snapshots' spread sets the states' box and length-scales.
        preset: "tuned" or "paper".
        name: Task name, "table-tennis" if None.
        seed: Of the exploration draws.

    Raises:
        Invalid: There is no such preset, or the name or seed is bad.
    """
    if preset not in PRESETS:
        raise Invalid(f"no preset {preset!r}; there are {', '.join(PRESETS)}")
    state = [
        {
            "name": axis,
            "unit": unit,
            "low": mean - BOX * spread,
            "high": mean + BOX * spread,
            "lengthscale": LENGTHSCALES[preset] * spread,
        }
        for (axis, unit), mean, spread in zip(STATE, launcher.centre, launcher.spread, strict=True)
    ]
    near = REACH if preset == "tuned" else 2 * max(POSITION_LIMITS)
    positions = [
        {
            "name": joint,
            "unit": "rad",
            "low": max(-limit, home - near),
            "high": min(limit, home + near),
            "scale": POSITION_SCALE,
        }
        for joint, limit, home in zip(JOINTS, POSITION_LIMITS, HOME.tolist(), strict=True)
    ]
    speeds = [
        {"name": f"{joint}_speed", "unit": "rad/s", "low": -limit, "high": limit, "scale": SPEED_SCALE}
        for joint, limit in zip(JOINTS, SPEED_LIMITS.tolist(), strict=True)
    ]
    hit_time = {"name": "hit_time", "unit": "s", "low": HIT_TIMES[0], "high": HIT_TIMES[1], "scale": TIME_SCALE}
    outcome = [
        *({"name": f"hit_{axis}", "unit": "m", "tolerance": HIT_TOLERANCE, "group": "hit"} for axis in "xyz"),
        *(
            {"name": f"landing_{axis}", "unit": "m", "tolerance": LANDING_TOLERANCE, "group": "landing"}
            for axis in "xy"
        ),
        {
            "name": "spare_time",
            "unit": "s",
            "target": SPARE_TIME,
            "tolerance": SPARE_TIME_TOLERANCE,
            "aim": "at_least",
        },
        {
            "name": "clearance",
            "unit": "m",
            "target": CLEARANCE,
            "tolerance": CLEARANCE_TOLERANCE,
            "aim": "at_least",
        },
    ]
    return TaskSpec.from_dict(
        {
            "name": name or NAME,
            "seed": seed,
            "state": state,
            "goal": [*positions, *speeds, hit_time],
            "outcome": outcome,
            **LEARNING[preset],
        }
    )
