"""A stroke for an arm of two joints: from rest through a position with a velocity at a given time, and back to rest.

Run it by `python examples/stroke.py`; it needs no server. `crkr.sim_worker.primitives.quadratic_program` has the maths.
"""

import numpy as np

from crkr.sim_worker.primitives import Infeasible, JointLimits, Primitive, spare_time

LIMITS = JointLimits(
    lower=np.array([-3.0, 0.0]),  # [rad]
    upper=np.array([3.0, 2.8]),
    speed=np.array([2.0, 3.0]),  # [rad/s]
    acceleration=np.array([20.0, 25.0]),  # [rad/s^2]
)
START = np.array([0.0, 1.5])  # [rad], at rest
GOAL = np.array([0.5, 0.9])  # [rad]
SPEED = np.array([1.2, -0.8])  # [rad/s]
HIT_TIME = 0.5  # [s]


def main() -> None:
    primitive = Primitive(LIMITS)
    stroke = primitive.trajectory(START, GOAL, SPEED, HIT_TIME)
    print("time [s]   position [rad]    velocity [rad/s]")
    times = np.linspace(0.0, stroke.time[-1], 10)
    for time, position, velocity in zip(times, *stroke.sample(times)[:2], strict=True):
        print(f"{time:8.2f}  {position[0]:7.3f} {position[1]:7.3f}   {velocity[0]:7.3f} {velocity[1]:7.3f}")

    spare = spare_time(LIMITS, GOAL - START, SPEED, HIT_TIME)
    print(f"the fastest stroke would hit {spare:.2f} s earlier")
    try:
        primitive.trajectory(START, GOAL, SPEED, hit_time=0.2)
    except Infeasible as refusal:
        print(f"a hit after 0.2 s is refused ({refusal.reason}): {refusal.message}")


if __name__ == "__main__":
    main()
