"""Goals and costs that are outside their bounds by rounding only are taken as the bound, in both forms one trial."""

from typing import Any
from uuid import UUID

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from crkr.protocol import Invalid, TaskSpec, Trial, make_trials, pack, unpack
from crkr.protocol.checks import cost_number, text


def spec(low: float, high: float) -> TaskSpec:
    goal = {"name": "a", "low": low, "high": high}
    return TaskSpec.from_dict({"name": "toss", "state": [{"name": "x", "low": 0, "high": 1}], "goal": [goal]})


def trial(spec: TaskSpec, goal: Any, cost: Any = 0.5) -> Trial:
    return Trial.create(spec, id=UUID(int=1), state=[0.5], goal=goal, cost=cost, success=True)


bounds = st.floats(-1e6, 1e6)


@given(bounds, bounds)
def test_a_bound_that_went_through_float32_is_the_bound(one: float, other: float) -> None:
    low, high = min(one, other), max(one, other)
    assume(max(abs(low), abs(high)) > 1e-30)  # float32 has steps below that are no part of the number
    task = spec(low, high)
    for bound in (low, high):
        assume(bound == 0.0 or abs(bound) > 1e-30)
        rounded = float(np.float32(bound))
        taken = trial(task, [rounded])
        assert low <= taken.goal[0] <= high
        if not low <= rounded <= high:
            assert taken.goal[0] == bound
            assert taken.digest() == trial(task, [bound]).digest()
            sent = {**unpack(pack(taken.to_wire())), "goal": [rounded]}  # by a client that does not move it
            assert Trial.from_wire(sent, task).digest() == taken.digest()


def test_more_than_rounding_is_refused() -> None:
    task = spec(-0.3, 0.7)
    assert trial(task, [0.7 + 9e-7]).goal.tolist() == [0.7]
    assert not trial(task, [0.7 + 9e-7]).goal.flags.writeable
    for goal in (0.7 + 2e-6, -0.3 - 2e-6, 1e300):
        with pytest.raises(Invalid, match=r"goal 'a' must be in \[-0.3, 0.7\]"):
            trial(task, [goal])
    with pytest.raises(Invalid, match="goal 'a' must be in"):
        trial(spec(1e-9, 1e-9), [2e-9])


def test_costs_are_rounded_alike() -> None:
    task = spec(0, 1)
    assert trial(task, [0.5], 1.0000001).digest() == trial(task, [0.5], 1.0).digest()
    assert trial(task, [0.5], -1e-9).digest() == trial(task, [0.5], 0.0).digest()
    assert trial(task, [0.5], np.float32(1) + np.float32(1e-7)).cost == 1.0
    for cost in (1.00001, -1e-5, float("inf"), float("nan")):
        with pytest.raises(Invalid, match="cost must be a finite number"):
            cost_number(cost, "cost")


def masked(*values: float) -> Any:
    return np.ma.masked_equal(values, 0.5)


@pytest.mark.parametrize(
    "changes",
    [
        {"state": masked(0.5)},
        {"goal": masked(0.5)},
        {"state": [masked(0.5)], "goal": [[0.5]]},
        {"cost": masked(0.5)},
        {"success": np.ma.masked_equal([True], False)},
        {"outcome": masked(0.5)},
        {"outcome": [np.ma.masked]},
    ],
)
def test_masked_arrays_are_refused_by_name(changes: dict[str, Any]) -> None:
    with pytest.raises(Invalid, match=f"({'|'.join(changes)})s? is a masked array"):
        make_trials(spec(0, 1), **{"state": [0.5], "goal": [0.5], "cost": 0.5, "success": True, **changes})


def test_text_that_no_message_can_carry_is_refused() -> None:
    with pytest.raises(Invalid, match="worker must be Unicode text"):
        text("\udcff", "worker")
