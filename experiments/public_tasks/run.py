"""Two public tasks of fancy_gym, learned from nothing through a server: success after 100, 300 and 1000 trials.

fancy_gym needs other versions of numpy, gymnasium and MuJoCo than crkr. It has an environment of its own, and
reaches the server with the client's sources:

    python -m venv /somewhere/fancy
    /somewhere/fancy/bin/pip install -r experiments/public_tasks/requirements.txt
    crkr server --listen tcp/127.0.0.1:7447 &
    PYTHONPATH=protocol:client /somewhere/fancy/bin/python experiments/public_tasks/run.py reacher5d --seed 1

`reacher5d` (context: 2, goal: 25 weights of a movement primitive) succeeds where the tip ends within 5 cm of its
target, and reports the two coordinates of the miss. `box-pushing` (4, 35) succeeds where the environment says so, and
reports how far the box is from its target and how far it is turned, signed. The first 100 trials fill the goals'
bounds; they count.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from typing import Any, ClassVar
from uuid import UUID

import fancy_gym  # noqa: F401 - registers the tasks
import gymnasium
import numpy as np

from crkr.client import Client

REACHED = 0.05  # [m], as both environments say
TURNED = 0.5  # [rad]
MARKS = (100, 300, 1000)
CONTEXTS = 200  # of an evaluation
RANDOM = 100  # first trials


class Reacher:
    """The tip of a planar arm to a target. With weights within 1 it would not get to a quarter of the targets."""

    name, bound, scale, temperature = "fancy_ProMP/Reacher5d-v0", 2.0, 0.6, (0.02, 0.1)
    outcome: ClassVar[dict[str, float]] = {"miss_x": REACHED / math.sqrt(2.0), "miss_y": REACHED / math.sqrt(2.0)}

    def context(self, observed: Any) -> Any:
        """The target [m]."""
        return observed

    def measured(self, environment: Any, end: Any) -> tuple[bool, list[float], float]:
        """Success, what was off, and a cost."""
        del environment  # unused: the episode's information says it
        off = (np.ravel(end["end_effector"][-1])[:2] - np.ravel(end["goal"][-1])[:2]).tolist()
        missed = float(np.linalg.norm(off))
        return missed < REACHED, off, float(-np.expm1(-0.5 * (missed / REACHED) ** 2))


class PushedBox:
    """A box to a place and an angle."""

    name, bound, scale, temperature = "fancy_ProMP/BoxPushingDense-v0", 1.0, 0.5, (0.02, 0.1, 0.5)
    outcome: ClassVar[dict[str, float]] = {
        "off_x": REACHED / math.sqrt(2.0),
        "off_y": REACHED / math.sqrt(2.0),
        "turned": TURNED,
    }

    def context(self, observed: Any) -> Any:
        """The numbers, of seven, that differ between contexts."""
        return observed[[0, 1, 3, 6]]

    def measured(self, environment: Any, end: Any) -> tuple[bool, list[float], float]:
        """Success, what was off, and a cost."""
        box, target = (environment.unwrapped.data.body(name) for name in ("box_0", "replan_target_pos"))
        turned = 2.0 * (math.atan2(box.xquat[3], box.xquat[0]) - math.atan2(target.xquat[3], target.xquat[0]))
        off = [*(box.xpos - target.xpos)[:2].tolist(), math.remainder(turned, 2.0 * math.pi)]
        missed = float(np.hypot(*off[:2]) / REACHED + abs(off[2]) / TURNED)
        return bool(np.ravel(end["is_success"])[-1]), off, float(-np.expm1(-0.5 * missed))


TASKS: dict[str, Any] = {"reacher5d": Reacher, "box-pushing": PushedBox}


def specification(task: Any, environment: Any, seed: int, neighbours: int) -> dict[str, Any]:
    """The task, with bounds of the state from contexts that were drawn."""
    seen = np.array([task.context(environment.reset(seed=10_000 + number)[0]) for number in range(200)])
    spread = np.maximum(np.ptp(seen, axis=0), 1e-3)
    limits = zip(seen.min(axis=0) - 0.1 * spread, seen.max(axis=0) + 0.1 * spread, strict=True)
    return {
        "name": f"{type(task).__name__.lower()}-{seed}",
        "seed": seed,
        "state": [{"name": f"s{n}", "low": float(low), "high": float(high)} for n, (low, high) in enumerate(limits)],
        "goal": [
            {"name": f"w{n}", "low": -task.bound, "high": task.bound, "scale": task.scale}
            for n in range(environment.action_space.shape[0])
        ],
        "outcome": [{"name": name, "tolerance": most, "group": "miss"} for name, most in task.outcome.items()],
        "start": {"type": "space-filling", "count": RANDOM},
        "learn_from": "successes",
        "exploration": {"type": "outcome", "neighbours": neighbours, "temperature": list(task.temperature)},
    }


def play(task: Any, environment: Any, goal: Any) -> tuple[bool, list[float], float]:
    """One episode: a whole movement."""
    _, _, _, _, info = environment.step(np.asarray(goal, dtype=np.float32))
    result: tuple[bool, list[float], float] = task.measured(environment, info)
    return result


def main() -> None:
    """Learn one task with one seed, and print a line of JSON at each mark."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, default=max(MARKS))
    parser.add_argument("--neighbours", type=int, default=200, help="trials that each model of outcomes is fitted to")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    task = TASKS[chosen.task]()
    environment = gymnasium.make(task.name)
    with Client(chosen.connect, timeout_s=30.0) as client:
        learned = client.create_task(specification(task, environment, chosen.seed, chosen.neighbours))
        for number in range(1, chosen.trials + 1):
            observed, _ = environment.reset(seed=1_000_000 * chosen.seed + number)
            state = task.context(observed)
            answer = learned.predict(state, explore=True, trial_ids=[UUID(int=number)])
            success, off, cost = play(task, environment, answer.goal)
            learned.report(answer, cost=cost, success=success, outcome=off, wait=True)
            if number in MARKS:
                won = 0
                for context in range(CONTEXTS):
                    observed, _ = environment.reset(seed=500_000 + context)
                    won += play(task, environment, learned.predict(task.context(observed)).goal)[0]
                line = {"task": chosen.task, "seed": chosen.seed, "trials": number, "success": won / CONTEXTS}
                sys.stdout.write(json.dumps(line) + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
