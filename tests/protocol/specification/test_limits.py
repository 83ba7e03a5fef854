"""Numbers that a new task may have, and those that it keeps from an earlier version."""

from __future__ import annotations

from typing import Any

import pytest

from crkr.protocol import MOST_ACTIVE, Invalid, TaskSpec, refuse_absurd

AXIS: dict[str, Any] = {"name": "x", "low": -1.0, "high": 1.0}
PLAIN: dict[str, Any] = {"name": "plain", "state": [AXIS], "goal": [AXIS]}
OUTCOME = {"name": "error", "tolerance": 0.1}

ABSURD: dict[str, dict[str, Any]] = {
    "kernel.signal_variance": {"kernel": {"signal_variance": 1e-310}},
    "kernel.linear_weight": {"kernel": {"linear_weight": 1e-200}},
    "noise_floor": {"noise_floor": 1e-100},
    "regularisation": {"regularisation": 5e-324},
    "explore_scale": {"explore_scale": 1e-300},
    "exploration_floor": {"exploration_floor": 1e-300},
    "exploration.trust": {"exploration": {"trust": 1e-300}},
    "exploration.temperature": {"exploration": {"temperature": [0.1, 1e-300]}},
    "exploration.gate": {"exploration": {"gate": 1e200}},
    "exploration.neighbours": {
        "outcome": [OUTCOME],
        "exploration": {"type": "outcome", "neighbours": 20_000, "iterations": 100},
        "state": [{**AXIS, "name": f"x{index}"} for index in range(20)],
    },
    "budget": {"budget": MOST_ACTIVE + 1},
    "state[0].high": {"state": [{**AXIS, "high": 1.7e308}]},
    "state[0].low": {"state": [{**AXIS, "low": -1e200}]},
    "state[0].high - low": {"state": [{**AXIS, "low": 0.0, "high": 1e-300, "lengthscale": 1.0}]},
    "state[0].lengthscale": {"state": [{**AXIS, "lengthscale": 1e-200}]},
    "goal[0].scale": {"goal": [{**AXIS, "scale": 1e-13}]},
    "goal[0].low": {"goal": [{**AXIS, "low": -1e101}]},
    "outcome[0].target": {"outcome": [{**OUTCOME, "target": 1e300}]},
    "outcome[0].tolerance": {"outcome": [{**OUTCOME, "target": 1.0, "tolerance": 1e-13}]},
}


@pytest.mark.parametrize("field", ABSURD)
def test_an_absurd_number_is_refused_by_the_name_of_its_field(field: str) -> None:
    spec = TaskSpec.from_dict({**PLAIN, **ABSURD[field]})  # as logs and messages of the version before are read
    with pytest.raises(Invalid) as refused:
        refuse_absurd(spec)
    assert refused.value.details == {"field": field}
    assert refused.value.message.startswith(f"{field} must be" if field != "exploration.neighbours" else field)


@pytest.mark.parametrize(
    ("groups", "exploration", "fits"),
    [
        (3, {"candidates": 1000, "neighbours": 100}, True),
        (40, {"candidates": 32, "neighbours": 100}, True),
        (1, {"candidates": 1000, "neighbours": 200}, True),
        (20, {"candidates": 1000, "neighbours": 200}, False),
        (256, {"candidates": 0, "neighbours": 200}, False),
        (256, {"candidates": 1000, "neighbours": 50}, False),
    ],
)
def test_a_prediction_that_would_hold_others_up_is_refused(
    groups: int, exploration: dict[str, Any], fits: bool
) -> None:
    outcome = [{**OUTCOME, "name": f"error {number}"} for number in range(groups)]
    spec = TaskSpec.from_dict({**PLAIN, "outcome": outcome, "exploration": {"type": "outcome", **exploration}})
    if fits:
        refuse_absurd(spec)
        return
    with pytest.raises(Invalid, match=rf"neighbours are too many for {groups} groups.* multiplications"):
        refuse_absurd(spec)


def test_more_temperatures_than_anyone_needs_are_refused() -> None:
    with pytest.raises(Invalid, match="at most 64"):
        refuse_absurd(TaskSpec.from_dict({**PLAIN, "exploration": {"temperature": [0.1] * 65}}))


@pytest.mark.parametrize(
    "usual",
    [
        {},
        {"state": [{**AXIS, "lengthscale": 1e9}]},  # a direction that does not matter
        {"state": [{**AXIS, "low": 0, "high": 1e-9}], "goal": [{**AXIS, "low": 1e6, "high": 1e6}]},
        {"outcome": [OUTCOME], "budget": MOST_ACTIVE},
        {"noise_floor": 1e-12, "regularisation": 1e-9, "explore_scale": 0.0, "selector": "full"},
        {"state": [{**AXIS, "name": f"x{index}"} for index in range(200)], "outcome": [OUTCOME]},
    ],
)
def test_unusual_numbers_that_can_be_computed_with_are_not_refused(usual: dict[str, Any]) -> None:
    refuse_absurd(TaskSpec.from_dict({**PLAIN, **usual}))


def test_a_change_is_not_refused_for_what_was_there_before() -> None:
    old = TaskSpec.from_dict({**PLAIN, "budget": 60_000, "kernel": {"signal_variance": 1e-310}})
    refuse_absurd(old.with_changes({"regularisation": 0.5}), old)
    refuse_absurd(old.with_changes({"budget": 10}), old)
    with pytest.raises(Invalid, match="budget"):
        refuse_absurd(old.with_changes({"budget": 70_000}), old)
