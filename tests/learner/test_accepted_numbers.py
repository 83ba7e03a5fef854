"""With any accepted numbers and any states a task learns, answers, fits and restarts."""

from __future__ import annotations

import math
from typing import Any
from uuid import UUID

import numpy as np
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from crkr.learner import Learner, check_fit, fit
from crkr.protocol import Invalid, TaskSpec, Trial, refuse_absurd

LENGTHS = st.floats(-103.0, 103.0).map(lambda power: 10.0**power)
SETTINGS = st.floats(-31.0, 6.0).map(lambda power: 10.0**power)
ENDS = st.builds(lambda sign, size: sign * size, st.sampled_from([-1.0, 0.0, 1.0]), LENGTHS)


@st.composite
def dimensions(draw: st.DrawFn, name: str, length: str) -> dict[str, Any]:
    low = draw(ENDS | st.floats(-10, 10))
    high = low + draw(LENGTHS | st.floats(0.1, 10)) if draw(st.booleans()) else draw(ENDS)
    given = {length: draw(LENGTHS)} if draw(st.booleans()) else {}
    return {"name": name, "low": min(low, high), "high": max(low, high), **given}


outcomes = st.lists(
    st.fixed_dictionaries({"tolerance": LENGTHS, "target": ENDS, "group": st.sampled_from("ab")}), max_size=2
).map(lambda entries: [{**entry, "name": str(index)} for index, entry in enumerate(entries)])
specs = st.fixed_dictionaries(
    {
        "name": st.just("any"),
        "state": st.lists(dimensions("", "lengthscale"), min_size=1, max_size=2),
        "goal": st.lists(dimensions("", "scale"), min_size=1, max_size=2),
        "outcome": outcomes,
        "kernel": st.fixed_dictionaries(
            {"signal_variance": SETTINGS, "linear_weight": st.just(0.0) | SETTINGS},
        ),
        "budget": st.integers(1, 30),
        "noise_floor": SETTINGS,
        "regularisation": SETTINGS,
        "explore_scale": st.just(0.0) | SETTINGS,
        "exploration_floor": st.just(0.0) | SETTINGS,
    },
    optional={
        "cost_map": st.sampled_from(["linear", "odds"]),
        "selector": st.sampled_from(["anms", "full", "freeze"]),
        "prior_mean": st.sampled_from(["zero", "demonstrations"]),
        "learn_from": st.just("all"),
    },
)
exploring = st.fixed_dictionaries(
    {"min_trials": st.just(5), "trust": SETTINGS, "temperature": st.lists(SETTINGS, min_size=1, max_size=3)}
)


def named(axes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{**axis, "name": str(index)} for index, axis in enumerate(axes)]


def trials(spec: TaskSpec, rng: np.random.Generator) -> list[Trial]:
    """Usual and unusual ones: states far away or all alike, goals at the bounds, costs of 0 and 1."""
    made: list[Trial] = []
    for number in range(24):
        state = [axis.low + float(rng.uniform()) * (axis.high - axis.low) for axis in spec.state]
        if number % 6 == 0:
            state = [float(rng.choice([-1.7e308, 1.7e308, 1e300, 0.0, 5e-324])) for _ in spec.state]
        goal = [
            min(max(axis.low + share * (axis.high - axis.low), axis.low), axis.high)
            for axis, share in zip(spec.goal, rng.choice([0.0, 0.3, 1.0], len(spec.goal)).tolist(), strict=True)
        ]
        measured = [
            float(rng.choice([-1.7e308, 1e300, 1.7e308, 5e-324, math.nan, entry.target])) for entry in spec.outcome
        ]
        made.append(
            Trial.create(
                spec,
                id=UUID(int=number + 1),
                state=state if number % 5 else made[0].state if made else state,
                goal=goal,
                cost=float(rng.choice([0.0, 5e-324, 1e-300, 0.4, 1.0])),
                success=bool(rng.uniform() < 0.8),
                kind="demonstration" if number % 8 == 0 else "trial",
                outcome=measured or None,
            )
        )
    return made


def assert_answers(learner: Learner) -> None:
    spec = learner.spec
    low, high = spec.bounds
    middle = np.array([axis.low / 2 + axis.high / 2 for axis in spec.state])
    states = np.stack([middle, [axis.low for axis in spec.state], np.full(len(middle), 1e300), np.zeros(len(middle))])
    ids = [UUID(int=number + 99) for number in range(len(states))]
    for explore in (False, True):
        answer = learner.model.predict(states, explore, ids)
        assert ((answer.goals >= low) & (answer.goals <= high)).all()
        for numbers in (answer.means, answer.sigmas, answer.novelty):
            assert np.isfinite(numbers).all()
        one = learner.model.predict(states[0], explore, ids[:1])
        assert np.isfinite(one.goals).all()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])
@given(specs, exploring, st.integers(0, 2**32 - 1))
def test_a_task_of_any_accepted_numbers_learns_answers_fits_and_restarts(
    fields: dict[str, Any], exploration: dict[str, Any], seed: int
) -> None:
    axes = {"state": named(fields["state"]), "goal": named(fields["goal"])}
    kind = "outcome" if fields["outcome"] else "gaussian"
    try:
        spec = TaskSpec.from_dict({**fields, **axes, "exploration": {"type": kind, **exploration}})
        refuse_absurd(spec)
    except Invalid:
        assume(False)
    learner = Learner(spec)
    told = trials(spec, np.random.default_rng(seed))
    for first in range(0, len(told), 6):
        part = told[first : first + 6]
        learner.apply_trials(range(first + 2, first + 2 + len(part)), part)
    assert_answers(learner)
    found = fit(learner.begin_fit())
    if found.accepted:
        check_fit(spec, found.lengthscales, found.signal_variance)
        learner.apply_fit(learner.version + 1, found.lengthscales, found.signal_variance)
        assert_answers(learner)
    learner.remove([told[0].id, told[6].id])
    learner.recost([told[1].id, told[7].id], [1.0, 0.0])
    again = Learner(spec)
    with again.bulk():
        again.apply_trials(range(2, len(told) + 2), told)
        if found.accepted:
            again.apply_fit(again.version + 1, found.lengthscales, found.signal_variance)
        again.remove([told[0].id, told[6].id])
        again.recost([told[1].id, told[7].id], [1.0, 0.0])
    assert again.active_ids == learner.active_ids
    assert_answers(again)
