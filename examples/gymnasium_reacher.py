"""Gymnasium's Reacher as a skill: an arm of two links learns which joint angles bring its tip to a target.

Start `crkr server` in another terminal, then, in this repository's folder:

    crkr workers examples/gymnasium_reacher.py:make -n 2 --trials 400
"""

from crkr.sim_worker.gymnasium import gymnasium_skill

make = gymnasium_skill(
    "Reacher-v5",
    state=["observation_4", "observation_5"],  # where the target is; all that varies unless given
    goal_bounds=([-3.1, 0.0], [3.1, 3.1]),  # the elbow bends one way
    outcome=lambda env, _: dict(zip("xy", env.get_body_com("fingertip") - env.get_body_com("target"), strict=False)),
    tolerance=0.02,  # [m]
)
