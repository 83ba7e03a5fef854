"""Three public tasks of fancy_gym, learned from nothing through a server: success after 100 to 2000 trials.

fancy_gym needs other versions of numpy, gymnasium and MuJoCo than crkr. It has an environment of its own, and
reaches the server with the client's sources:

    python -m venv /somewhere/fancy
    /somewhere/fancy/bin/pip install -r experiments/public_tasks/requirements.txt
    crkr server --listen tcp/127.0.0.1:7447 &
    PYTHONPATH=protocol:client /somewhere/fancy/bin/python experiments/public_tasks/run.py reacher5d --seed 1

`reacher5d` (context: 2, goal: 25 weights of a movement primitive) succeeds where the tip ends within 5 cm of its
target, and reports the two coordinates of the miss. `box-pushing` (4, 35) succeeds where the environment says so, and
reports how far the box is from its target and how far it is turned, signed. `table-tennis` (4, 14) succeeds where the
environment says so: the ball comes back to within 20 cm of a place. It reports where the racket is when the ball comes
level with it, with which velocity the ball would leave it, and where a ball that was hit comes down. The first 100
trials fill the goals' bounds; they count.
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
CONTEXTS = 200  # of an evaluation
RANDOM = 100  # first trials
GRAVITY = np.array([0.0, 0.0, -9.81])  # [m/s^2]


Measured = tuple[bool, list[float], float | None]  # success, outcome and cost; none of a movement that was refused


class Reacher:
    """The tip of a planar arm to a target. With weights within 1 it would not get to a quarter of the targets."""

    name, marks, drift = "fancy_ProMP/Reacher5d-v0", (100, 300, 1000), True
    bounds, scale, temperature = ((-2.0, 2.0),) * 25, 0.6, (0.02, 0.1)
    outcome: ClassVar[dict[str, tuple[str, float]]] = {
        "miss_x": ("miss", REACHED / math.sqrt(2.0)),
        "miss_y": ("miss", REACHED / math.sqrt(2.0)),
    }

    def watch(self, environment: Any) -> None:
        """Nothing: its information says all."""

    def context(self, observed: Any) -> Any:
        """The target [m]."""
        return observed

    def action(self, goal: Any) -> Any:
        """The weights."""
        return goal

    def measured(self, environment: Any, end: Any) -> Measured:
        """Success, what was off, and a cost."""
        del environment  # unused: the episode's information says it
        off = (np.ravel(end["end_effector"][-1])[:2] - np.ravel(end["goal"][-1])[:2]).tolist()
        missed = float(np.linalg.norm(off))
        return missed < REACHED, off, float(-np.expm1(-0.5 * (missed / REACHED) ** 2))


class PushedBox:
    """A box to a place and an angle."""

    name, marks, drift = "fancy_ProMP/BoxPushingDense-v0", (100, 300, 1000), True
    bounds, scale, temperature = ((-1.0, 1.0),) * 35, 0.5, (0.02, 0.1, 0.5)
    outcome: ClassVar[dict[str, tuple[str, float]]] = {
        "off_x": ("miss", REACHED / math.sqrt(2.0)),
        "off_y": ("miss", REACHED / math.sqrt(2.0)),
        "turned": ("miss", TURNED),
    }

    def watch(self, environment: Any) -> None:
        """Nothing: its state at the end says all."""

    def context(self, observed: Any) -> Any:
        """The numbers, of seven, that differ between contexts."""
        return observed[[0, 1, 3, 6]]

    def action(self, goal: Any) -> Any:
        """The weights."""
        return goal

    def measured(self, environment: Any, end: Any) -> Measured:
        """Success, what was off, and a cost."""
        box, target = (environment.unwrapped.data.body(name) for name in ("box_0", "replan_target_pos"))
        turned = 2.0 * (math.atan2(box.xquat[3], box.xquat[0]) - math.atan2(target.xquat[3], target.xquat[0]))
        off = [*(box.xpos - target.xpos)[:2].tolist(), math.remainder(turned, 2.0 * math.pi)]
        missed = float(np.hypot(*off[:2]) / REACHED + abs(off[2]) / TURNED)
        return bool(np.ravel(end["is_success"])[-1]), off, float(-np.expm1(-0.5 * missed))


class ReturnedBall:
    """A ball back over the net to a place. Held: the movement's duration, its delay, and each joint's first weight.

    The first basis has faded when the ball comes. A weight turns its joint by some 0.7 rad, and is bounded by the
    joint's limits [rad]. A movement over the limits is refused. Outcomes jump where the racket just touches the ball,
    which the watch for a changed robot may take for a change; it is off.
    """

    name, marks, drift = "fancy_ProDMP/TableTennis4D-v0", (300, 1000, 2000), False
    limits = ((-2.6, 2.6), (-2.0, 2.0), (-2.8, 2.8), (-0.9, 3.1), (-4.8, 1.3), (-1.6, 1.6), (-2.2, 2.2))
    bounds, scale, temperature = tuple(limit for limit in limits for _ in range(2)), 0.5, (0.02, 0.1, 0.5)
    outcome: ClassVar[dict[str, tuple[str, float]]] = {
        **{f"miss_{axis}": ("miss", 0.02) for axis in "xyz"},
        **{f"land_{axis}": ("land", 0.07) for axis in "xy"},
        **{f"leave_{axis}": ("leave", 0.12) for axis in "xyz"},
    }
    duration, delay, flight, table = 1.2, 0.1, 0.62, 0.795  # [s], [s], [s], [m]; the ball's flight back, its height
    step = 0.002  # [s] of the simulation

    def watch(self, environment: Any) -> None:
        """Record the racket's normal and place, the ball's place and velocity, at each step of the simulation."""
        inner = environment.unwrapped
        self.seen: list[Any] = []
        simulate = inner.do_simulation

        def recorded(*arguments: Any) -> None:
            simulate(*arguments)
            racket, ball = inner.data.geom("bat"), inner.data.body("target_ball")
            self.seen.append([*racket.xmat[2::3], *racket.xpos, *ball.xpos, *inner.data.qvel[7:10]])

        inner.do_simulation = recorded

    def context(self, observed: Any) -> Any:
        """Where the ball starts and where it should come down [m]."""
        return observed

    def action(self, goal: Any) -> Any:
        """Duration, delay, and three weights for each joint."""
        self.seen.clear()
        weights = np.zeros((len(self.limits), 3))
        weights[:, 1:] = np.reshape(goal, (-1, 2))
        return np.concatenate([[self.duration, self.delay], weights.ravel()])

    def measured(self, environment: Any, end: Any) -> Measured:
        """Success, what was off, and a cost; landing is unknown unless the racket's middle hit."""
        if not self.seen:
            return False, [math.nan] * len(self.outcome), None
        normal, racket, ball, velocity = np.split(np.array(self.seen), 4, axis=1)
        success, target = bool(np.ravel(end["is_success"])[-1]), environment.unwrapped._goal_pos
        jumped = np.linalg.norm(np.diff(velocity, axis=0) - self.step * GRAVITY, axis=1) > 0.05
        touches = np.flatnonzero(jumped & (np.linalg.norm(ball - racket, axis=1)[1:] < 0.2))
        hit = bool(np.ravel(end["hit_ball"])[-1]) and touches.size > 0
        last = touches[0] if hit else len(ball) - 1  # step of the free flight

        plane = 1.5 + 0.4 * (ball[0, 0] + 0.6)  # [m] from the net: where the arm reaches, and at nearly the same time
        level = int(np.argmax(ball[: last + 1, 0] >= plane))
        place, free = ball[level], velocity[level]
        if not level:  # it was hit before, and would have flown on
            time = (plane - ball[last, 0]) / max(velocity[last, 0], 0.5)
            level = min(last + round(time / self.step), len(ball) - 1)
            place = ball[last] + time * velocity[last] + time**2 / 2.0 * GRAVITY
            free = velocity[last] + time * GRAVITY
        miss = racket[level] - place
        met = min(level, last)
        moved = (racket[met] - racket[met - 1]) / self.step
        along = ((free - moved) @ normal[met]) * normal[met]
        leaves = moved - 0.55 * along + 0.87 * (free - moved - along)
        needed = (np.array([*target, self.table]) - place) / self.flight - self.flight / 2.0 * GRAVITY

        land = np.full(2, math.nan)
        if hit:
            beside = ball[last] - racket[last]
            beside = beside - (beside @ normal[last]) * normal[last]
            gone = min(touches[touches < last + 40][-1] + 1, len(ball) - 1)
            if success or np.linalg.norm(beside) < 0.06:
                land = landing(ball[gone], velocity[gone], self.table) - target
        if np.isnan(land[0]):
            cost = 1.0 - 0.5 * math.exp(-0.5 * float(miss @ miss) / 0.3**2)
        else:
            cost = 0.5 - 0.5 * math.exp(-0.5 * float(land @ land) / 0.4**2)
        return success, [*miss, *land, *(leaves - needed)], cost


def landing(place: Any, velocity: Any, height: float) -> Any:
    """Where a ball in free flight comes down to a height, (2,) [m]."""
    fall = -GRAVITY[2]
    time = (velocity[2] + math.sqrt(max(velocity[2] ** 2 + 2.0 * fall * (place[2] - height), 0.0))) / fall
    return place[:2] + time * velocity[:2]


TASKS: dict[str, Any] = {"reacher5d": Reacher, "box-pushing": PushedBox, "table-tennis": ReturnedBall}


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
            {"name": f"w{n}", "low": low, "high": high, "scale": task.scale}
            for n, (low, high) in enumerate(task.bounds)
        ],
        "outcome": [{"name": name, "tolerance": most, "group": group} for name, (group, most) in task.outcome.items()],
        "start": {"type": "space-filling", "count": RANDOM},
        "learn_from": "successes",
        "exploration": {
            "type": "outcome",
            "neighbours": neighbours,
            "temperature": list(task.temperature),
            "drift": task.drift,
        },
    }


def play(task: Any, environment: Any, goal: Any) -> Measured:
    """One episode: a whole movement."""
    _, _, _, _, info = environment.step(np.asarray(task.action(goal), dtype=np.float32))
    result: Measured = task.measured(environment, info)
    return result


def main() -> None:
    """Learn one task with one seed, and print a line of JSON at each mark."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, help="how many; up to the last mark unless given")
    parser.add_argument("--neighbours", type=int, default=200, help="trials that each model of outcomes is fitted to")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    task = TASKS[chosen.task]()
    environment = gymnasium.make(task.name)
    task.watch(environment)
    with Client(chosen.connect, timeout_s=30.0) as client:
        learned = client.create_task(specification(task, environment, chosen.seed, chosen.neighbours))
        for number in range(1, (chosen.trials or max(task.marks)) + 1):
            observed, _ = environment.reset(seed=1_000_000 * chosen.seed + number)
            state = task.context(observed)
            answer = learned.predict(state, explore=True, trial_ids=[UUID(int=number)])
            success, off, cost = play(task, environment, answer.goal)
            kind = "failed" if cost is None else "trial"
            learned.report(answer, cost=cost, success=success, outcome=off, kind=kind, wait=True)
            if number in task.marks:
                won = 0
                for context in range(CONTEXTS):
                    observed, _ = environment.reset(seed=500_000 + context)
                    won += play(task, environment, learned.predict(task.context(observed)).goal)[0]
                line = {"task": chosen.task, "seed": chosen.seed, "trials": number, "success": won / CONTEXTS}
                sys.stdout.write(json.dumps(line) + "\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
