"""Two public tasks of fancy_gym, learned from nothing through a server: success after 100, 300 and 1000 trials.

fancy_gym needs other versions of numpy, gymnasium and MuJoCo than crkr. It has an environment of its own, and
reaches the server with the client's sources:

    python -m venv /somewhere/fancy
    /somewhere/fancy/bin/pip install -r experiments/public_tasks/requirements.txt
    crkr server --listen tcp/127.0.0.1:7447 &
    PYTHONPATH=protocol:client /somewhere/fancy/bin/python experiments/public_tasks/run.py reacher5d --seed 1

`reacher5d` (context: 2, goal: 25 weights of a movement primitive) succeeds where the tip ends within 5 cm of its
target, and reports the two coordinates of the miss. `box-pushing` (4, 35) succeeds where the environment says so, and
reports position and angle of the box from its target. The first 100 trials fill the goals' bounds; they count.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from typing import Any
from uuid import UUID

import fancy_gym  # noqa: F401 - registers the tasks
import gymnasium
import numpy as np

from crkr.client import Client

REACHED = 0.05  # [m]
MARKS = (100, 300, 1000)
CONTEXTS = 200  # of an evaluation
RANDOM = 100  # first trials


class Reacher:
    """The tip of a planar arm to a target."""

    name, bound = "fancy_ProMP/Reacher5d-v0", 1.0
    outcome = ("miss_x", "miss_y")
    tolerance = REACHED

    def context(self, observed: Any) -> Any:
        """The target [m]."""
        return observed

    def measured(self, end: Any, start: Any) -> tuple[bool, list[float], float]:
        """Success, what was off, and a cost."""
        del start  # Unused.
        off = (np.ravel(end["end_effector"][-1])[:2] - np.ravel(end["goal"][-1])[:2]).tolist()
        missed = float(np.linalg.norm(off))
        return missed < REACHED, off, float(-np.expm1(-0.5 * (missed / REACHED) ** 2))


class PushedBox:
    """A box to a place and an angle."""

    name, bound = "fancy_ProMP/BoxPushingDense-v0", 1.0
    outcome = ("away", "turned")
    tolerance = 0.05

    def context(self, observed: Any) -> Any:
        """Those of the seven numbers that differ between contexts."""
        return observed[[0, 1, 3, 6]]

    def measured(self, end: Any, start: Any) -> tuple[bool, list[float], float]:
        """Success, what was off, and a cost."""
        del start  # Unused.
        off = [float(np.ravel(end[name])[-1]) for name in ("box_goal_pos_dist", "box_goal_rot_dist")]
        return bool(np.ravel(end["is_success"])[-1]), off, float(-np.expm1(-np.linalg.norm(off)))


TASKS: dict[str, Any] = {"reacher5d": Reacher, "box-pushing": PushedBox}


def specification(task: Any, environment: Any, seed: int) -> dict[str, Any]:
    """The task, with bounds of the state from contexts that were drawn."""
    seen = np.array([task.context(environment.reset(seed=10_000 + number)[0]) for number in range(200)])
    spread = np.maximum(np.ptp(seen, axis=0), 1e-3)
    limits = zip(seen.min(axis=0) - 0.1 * spread, seen.max(axis=0) + 0.1 * spread, strict=True)
    return {
        "name": f"{type(task).__name__.lower()}-{seed}",
        "seed": seed,
        "state": [{"name": f"s{n}", "low": float(low), "high": float(high)} for n, (low, high) in enumerate(limits)],
        "goal": [
            {"name": f"w{n}", "low": -task.bound, "high": task.bound} for n in range(environment.action_space.shape[0])
        ],
        "outcome": [{"name": name, "tolerance": task.tolerance, "group": "miss"} for name in task.outcome],
        "start": {"type": "space-filling", "count": RANDOM},
        "learn_from": "successes",
    }


def play(task: Any, environment: Any, goal: Any, start: Any) -> tuple[bool, list[float], float]:
    """One episode: a whole movement."""
    _, _, _, _, info = environment.step(np.asarray(goal, dtype=np.float32))
    result: tuple[bool, list[float], float] = task.measured(info, start)
    return result


def main() -> None:
    """Learn one task with one seed, and print a line of JSON at each mark."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, default=max(MARKS))
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    task = TASKS[chosen.task]()
    environment = gymnasium.make(task.name)
    with Client(chosen.connect, timeout_s=30.0) as client:
        learned = client.create_task(specification(task, environment, chosen.seed))
        for number in range(1, chosen.trials + 1):
            observed, _ = environment.reset(seed=1_000_000 * chosen.seed + number)
            state = task.context(observed)
            answer = learned.predict(state, explore=True, trial_ids=[UUID(int=number)])
            success, off, cost = play(task, environment, answer.goal, observed)
            learned.report(answer, cost=cost, success=success, outcome=off, wait=True)
            if number in MARKS:
                won = 0
                for context in range(CONTEXTS):
                    observed, _ = environment.reset(seed=500_000 + context)
                    won += play(task, environment, learned.predict(task.context(observed)).goal, observed)[0]
                line = {"task": chosen.task, "seed": chosen.seed, "trials": number, "success": won / CONTEXTS}
                sys.stdout.write(json.dumps(line) + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
