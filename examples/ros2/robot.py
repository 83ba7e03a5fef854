"""A robot's node that learns to throw by the services of node.py: ask, throw, measure, report.

README.md has the same program with rclpy.

    python examples/ros2/robot.py throw 200 --router 127.0.0.1:7447
"""

import argparse
from contextlib import closing

import numpy as np
from node import address, await_service, definition  # type: ignore[import-not-found]  # beside this file
from zenoh_ros2_sdk import ROS2ServiceClient

GRAVITY = 9.81  # [m/s^2]


def throw(distance: float, goal: np.ndarray) -> float:
    """Your robot goes here: throws with (speed, angle) and measures by how much it was too far [m]."""
    speed, angle = goal
    return float(speed**2 * np.sin(2 * angle) / GRAVITY - distance)


def main() -> None:
    parser = argparse.ArgumentParser(description="Learn to throw over ROS 2 services.")
    parser.add_argument("task")
    parser.add_argument("trials", type=int)
    parser.add_argument("--router", default="127.0.0.1:7447", help="HOST:PORT of rmw_zenohd")
    options = parser.parse_args()
    there, name = address(options.router), "/" + options.task.replace("-", "_")
    rng, hits = np.random.default_rng(0), []
    with (
        closing(ROS2ServiceClient(f"{name}/predict", **definition("Predict"), **there)) as predict,
        closing(ROS2ServiceClient(f"{name}/report", **definition("Report"), **there)) as report,
    ):
        for service in (predict, report):
            await_service(service)
        for _ in range(options.trials):
            state = rng.uniform(2.0, 8.0, 1)
            answer = predict.call(state=state, explore=True)
            if answer is None or not answer.ok:
                raise SystemExit(f"no goal: {'no answer' if answer is None else answer.error}")
            off = throw(state[0], answer.goal)
            hits.append(abs(off) < 0.25)
            trial = {"trial_id": answer.trial_id, "state": state, "goal": answer.goal, "kind": "", "success": hits[-1]}
            receipt = report.call(cost=1 - np.exp(-abs(off)), outcome=np.array([off]), **trial)
            if receipt is None or not receipt.ok:
                raise SystemExit(f"not stored: {'no answer' if receipt is None else receipt.error}")
    print(f"hits of the first 20: {np.mean(hits[:20]):.0%}, of the last 20: {np.mean(hits[-20:]):.0%}")


if __name__ == "__main__":
    main()
