"""Cost-regularized Kernel Regression in one dimension: a demonstration, five tries, and the policy they make."""

import sys

import matplotlib.pyplot as plt
import numpy as np

from crkr.learner import Learner, saturated_cost
from crkr.protocol import TaskSpec

axes = {"state": [{"name": "s", "low": -3, "high": 3}], "goal": [{"name": "g", "low": -3, "high": 3, "scale": 1}]}
learner = Learner(TaskSpec.from_dict({"name": "wave", **axes, "seed": 4}))
best = np.sin  # the goal that would cost nothing; the learner never sees it

learner.report(state=[-1.0], goal=best([-1.0]), cost=0.0, success=True, kind="demonstration")
for state in (0.2, -2.3, 1.6, 0.9, 2.6):
    answer = learner.predict([state], explore=True)
    learner.report(answer, cost=saturated_cost(answer.goal - best(state), length=0.8), success=True)

states = np.linspace(-3, 3, 200)
policy, tried = learner.predict(states[:, None]), learner.model
mean, sigma = policy.means[:, 0], policy.sigmas[:, 0]
plt.fill_between(states, mean - sigma, mean + sigma, color="pink", label="exploration")
plt.plot(states, best(states), "k:", label="best goal")
plt.plot(states, mean, label="mean")
plt.errorbar(tried.states[:, 0], tried.goals[:, 0], tried.costs, fmt="o", capsize=4, label="samples and their costs")
plt.legend()
plt.savefig(picture := sys.argv[1] if len(sys.argv) > 1 else "crkr_1d.png")
print(f"picture: {picture}")
