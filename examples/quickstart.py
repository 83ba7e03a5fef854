"""A robot learns to throw at any distance, from three demonstrations, through a policy service.

Start the service in another terminal, then run this:

    crkr server
    python examples/quickstart.py [tcp/127.0.0.1:7447]
"""

import sys

import numpy as np

from crkr.client import Client, Task
from crkr.protocol import Unavailable

GRAVITY = 9.81  # [m/s^2]
SPEC = {
    "name": "quickstart-throw",
    "state": [{"name": "distance", "unit": "m", "low": 2.0, "high": 8.0, "lengthscale": 1.0}],
    "goal": [
        {"name": "speed", "unit": "m/s", "low": 2.0, "high": 12.0, "scale": 0.6},
        {"name": "angle", "unit": "rad", "low": 0.3, "high": 1.2, "scale": 0.05},
    ],
}


def swing(distance: float, goal: np.ndarray) -> tuple[float, bool]:
    """Your robot goes here: throws with (speed, angle) and measures the cost in [0, 1] and whether it hit."""
    speed, angle = goal
    miss = abs(speed**2 * np.sin(2 * angle) / GRAVITY - distance)
    return float(1 - np.exp(-miss)), bool(miss < 0.25)


def hits(task: Task, distances: np.ndarray) -> float:
    """The share of distances that the best known goals hit."""
    goals = task.predict(distances[:, None]).goals
    return float(np.mean([swing(distance, goal)[1] for distance, goal in zip(distances, goals, strict=True)]))


def main() -> None:
    endpoint = sys.argv[1] if len(sys.argv) > 1 else None
    judged = np.linspace(2.0, 8.0, 61)
    rng = np.random.default_rng(0)
    with Client(endpoint) as client:
        task = client.create_task(SPEC)
        if task.created:
            for distance in (2.0, 5.0, 8.0):
                shown = [np.sqrt(GRAVITY * distance), np.pi / 4]
                task.report(state=[distance], goal=shown, cost=0.0, success=True, kind="demonstration", wait=True)
        print(f"before: {hits(task, judged):.0%} of the targets hit")
        for _ in range(300):
            distance = rng.uniform(2.0, 8.0)
            answer = task.predict([distance], explore=True)  # .goal .mean .sigma .novelty .trial_id .model_version
            cost, success = swing(distance, answer.goal)
            task.report(answer, cost=cost, success=success, wait=True)
        print(f"after:  {hits(task, judged):.0%}, from {task.status()['active']} active samples")


if __name__ == "__main__":
    try:
        main()
    except Unavailable as error:
        sys.exit(f"error: {error}")
