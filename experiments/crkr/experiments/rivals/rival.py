"""The interface of methods that learn a skill by trials, crkr's learner included."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol, final

import numpy as np

from crkr.learner import Learner, SelectorFactory
from crkr.protocol import Array, TaskSpec, training_id
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["Crkr", "InitialDesign", "Offsets", "Rival", "TaskScales", "cost_of"]

DESIGN: Final = 10  # trials; of 10, 20 and 40 the best for forward models of the throw, seeds 40 to 42


class Rival(Protocol):
    """Learns goals for states from trials, in their order.

    Its behaviour is a function of specification and seed. Goals are within their bounds.
    """

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Takes the demonstrations, before the first trial."""

    def ask(self, state: Array) -> Array:
        """The goal (p,) to try in a state (d,), with exploration."""

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Takes the result of the last goal."""

    def policy(self, states: Array) -> Array:
        """The best goals (b, p) for states (b, d), without exploration; changes nothing."""


@final
class TaskScales:
    """Scales of states, goals and outcomes in which a task's entries are comparable.

    States are in the demonstrations' standard deviations around their mean (a length-scale where these are zero),
    goals in their scales around it, outcomes in their tolerances from the target.
    """

    def __init__(self, spec: TaskSpec, demonstrations: Sequence[Demonstration]) -> None:
        plain = spec.to_dict()
        self.low = np.array([entry["low"] for entry in plain["goal"]])
        self.high = np.array([entry["high"] for entry in plain["goal"]])
        spread = np.std([one.state for one in demonstrations], axis=0)
        self._state_unit = np.where(spread > 0, spread, [entry["lengthscale"] for entry in plain["state"]])
        self._goal_unit = np.array([entry["scale"] for entry in plain["goal"]])
        self._target = np.array([entry["target"] for entry in plain["outcome"]])
        self._tolerance = np.array([entry["tolerance"] for entry in plain["outcome"]])
        # Which side of the target is wrong: both (0), below (-1) or above (+1).
        self.side = np.array([{"equal": 0, "at_least": -1, "at_most": 1}[entry["aim"]] for entry in plain["outcome"]])
        self._state_mean = np.mean([one.state for one in demonstrations], axis=0)
        self._goal_mean = np.mean([one.goal for one in demonstrations], axis=0)

    def states(self, states: Array) -> Array:
        """Scaled states of the same shape."""
        scaled: Array = (states - self._state_mean) / self._state_unit
        return scaled

    def goals(self, goals: Array) -> Array:
        """Scaled goals of the same shape."""
        scaled: Array = (goals - self._goal_mean) / self._goal_unit
        return scaled

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,) of scaled goals."""
        return self.goals(self.low), self.goals(self.high)

    def real_goals(self, scaled: Array) -> Array:
        """Goals of scaled ones, clipped to their bounds."""
        clipped: Array = np.clip(self._goal_mean + scaled * self._goal_unit, self.low, self.high)
        return clipped

    def outcomes(self, outcome: Array) -> Array:
        """Deviations from the target (q,) in tolerances; NaN stays."""
        scaled: Array = (outcome - self._target) / self._tolerance
        return scaled


@final
class Offsets:
    """Goals as offsets from behaviour cloning, a ridge regression of the demonstrations, in scales of the goal."""

    def __init__(self, spec: TaskSpec, demonstrations: Sequence[Demonstration]) -> None:
        from sklearn.linear_model import Ridge  # half a second, which runs of crkr's own learner are spared

        self.scales = TaskScales(spec, demonstrations)
        states, goals = (np.array([getattr(one, name) for one in demonstrations]) for name in ("state", "goal"))
        self._cloned = Ridge(1.0).fit(self.scales.states(states), self.scales.goals(goals))

    def of(self, state: Array, goal: Array) -> Array:
        """The offset (p,) of a goal in a state."""
        offset: Array = self.scales.goals(goal) - self._cloned.predict(self.scales.states(state)[None, :])[0]
        return offset

    def goals(self, states: Array, offsets: Array) -> Array:
        """Goals (b, p) within their bounds."""
        return self.scales.real_goals(self._cloned.predict(self.scales.states(states)) + offsets)


def cost_of(result: TrialResult) -> float:
    """The cost for methods without outcomes; 1 if nothing was executed or measured."""
    return 1.0 if result.cost is None else float(result.cost)


@final
class InitialDesign:
    """A rival without demonstrations: it starts from trials of random goals within the bounds."""

    def __init__(self, rival: Rival, spec: TaskSpec, seed: int) -> None:
        self._rival, self._rng = rival, np.random.default_rng((seed, 1))
        self._low, self._high = (np.array([getattr(entry, side) for entry in spec.goal]) for side in ("low", "high"))
        self._trials: list[Demonstration] = []

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """There are no demonstrations."""

    def ask(self, state: Array) -> Array:
        """A uniform draw, or the rival's goal."""
        return self._rng.uniform(self._low, self._high) if self._short else self._rival.ask(state)

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Starts the rival when the design is complete."""
        if not self._short:
            self._rival.tell(state, goal, result)
            return
        self._trials.append(Demonstration(state, goal, result))
        if len(self._trials) == DESIGN:
            self._rival.start(self._trials)

    def policy(self, states: Array) -> Array:
        """The middle of the bounds, until the rival has a policy."""
        if self._short:
            return np.tile((self._low + self._high) / 2, (len(states), 1))
        return self._rival.policy(states)

    @property
    def _short(self) -> bool:
        return len(self._trials) < DESIGN


@final
class Crkr:
    """crkr's own learner, as a worker uses it; a `selector` replaces the specification's."""

    def __init__(self, spec: TaskSpec, seed: int, selector: SelectorFactory | None = None) -> None:
        self.learner = Learner(TaskSpec.from_dict({**spec.to_dict(), "seed": seed}), selector=selector)
        self._seed = seed
        self._trials = 0

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Reports them with kind demonstration."""
        for shown in demonstrations:
            result = shown.result
            self.learner.report(
                state=shown.state, goal=shown.goal, cost=result.cost, success=True, kind="demonstration",
                outcome=result.outcome,
            )  # fmt: skip

    def ask(self, state: Array) -> Array:
        """The goal of an exploring prediction."""
        self._trials += 1
        trial_id = training_id(self.learner.spec.name, self._seed, 1, self._trials)
        self._answer = self.learner.predict(state, explore=True, trial_ids=trial_id)
        goals: Array = self._answer.goals
        return goals

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Reports the trial."""
        del state, goal  # Unused: they are the answer's.
        kind = "trial" if result.executed else "failed"
        self.learner.report(
            self._answer, cost=result.cost, success=result.success and result.executed, kind=kind,
            outcome=result.outcome, learn=result.learn if result.executed else None,
        )  # fmt: skip

    def policy(self, states: Array) -> Array:
        """Means of the regression, moved by outcomes where the task has them."""
        goals: Array = self.learner.predict(states).goals
        return goals
