"""Where a correction starts if the mean of the successes misses by far."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crkr.learner import Learner
from crkr.learner.exploration.outcome_index import OutcomeIndex
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.exploration.tried_goals import least_missing
from crkr.learner.samples.store import SampleStore
from crkr.protocol import Array, TaskSpec, make_trials

MakeSpec = Callable[..., TaskSpec]
OUTCOME = [{"name": "miss", "tolerance": 0.1}]


def miss(states: Array, goals: Array) -> Array:
    """Zero on a parabola: a number and its opposite do the same, their mean does not."""
    return np.asarray(4.0 * goals[:, :1] ** 2 - 1.0 - 0.2 * states[:, :1])


def test_where_opposite_goals_succeed_and_their_mean_fails_one_of_them_is_corrected(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec(1, 2, outcome=OUTCOME, seed=3))
    rng = np.random.default_rng(1)
    states, goals = rng.uniform(-2, 2, (200, 1)), rng.uniform(-1, 1, (200, 2))
    goals[::2, 0] = np.sign(goals[::2, 0]) * np.sqrt((1.0 + 0.2 * states[::2, 0]) / 4.0)  # these succeed
    outcome = miss(states, goals)
    hit = np.abs(outcome[:, 0]) < 0.1
    learner.report(state=states, goal=goals, cost=np.where(hit, 0.1, 1.0), success=list(hit), outcome=outcome)
    answer = learner.predict(np.linspace(-1.5, 1.5, 20)[:, None])
    assert np.abs(miss(answer.states, answer.means)).max() > 0.3
    assert np.mean(np.abs(miss(answer.states, answer.goals)) < 0.1) >= 0.9
    tried = learner.predict(answer.states, explore=True)
    assert np.mean(np.abs(miss(tried.states, tried.goals)) < 0.1) > 0.5


def test_outcomes_are_moved_to_the_state_that_is_asked_for(make_spec: MakeSpec) -> None:
    spec = make_spec(1, 1, outcome=OUTCOME)
    scales, store = OutcomeScales.of(spec), SampleStore(1, 1, 1)
    near, far = ([0.0], [0.1], [0.2]), ([-1.0], [0.7], [-0.3])
    for seq, (state, goal_tried, outcome) in enumerate((near, far), 2):
        trials = make_trials(spec, state=state, goal=goal_tried, outcome=outcome, cost=0.5, success=False)
        store.append(seq, trials[0])
    index = OutcomeIndex(scales, store)
    index.extend(np.arange(2))
    z = scales.metric.standardise(np.zeros((1, 1)))
    entries = np.arange(1)
    step = float(z[0, 0] - index.snapshot().X[1, 0])

    def goal(*slopes: Array) -> float:
        scaled, _ = least_missing(index.snapshot(), entries, np.zeros(1), z, *slopes)
        return round(float((scales.middle + scales.scales * scaled)[0, 0]), 6)

    assert goal() == 0.1
    assert goal(np.zeros((1, 1, 1))) == 0.1
    assert goal(np.full((1, 1, 1), 3.0 / step)) == 0.7
