"""A specification: its defaults, what it refuses, and how two of them differ."""

import copy
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.protocol import CHANGEABLE, Invalid, TaskSpec, pack, unpack

THROW: dict[str, Any] = {
    "name": "throw",
    "state": [{"name": "distance", "unit": "m", "low": 0, "high": 4}, {"name": "height", "low": -1, "high": 1}],
    "goal": [{"name": "speed", "unit": "m/s", "low": 0, "high": 8, "scale": 0.5}],
}
OUTCOME = [{"name": "error", "unit": "m", "tolerance": 0.1}, {"name": "late", "tolerance": 1, "group": "error"}]


def test_defaults_are_those_of_the_paper_or_better_known() -> None:
    spec = TaskSpec.from_dict(THROW)
    assert spec.to_dict() == {
        "name": "throw",
        "state": [
            {"name": "distance", "unit": "m", "low": 0.0, "high": 4.0, "lengthscale": 1.0},
            {"name": "height", "unit": "", "low": -1.0, "high": 1.0, "lengthscale": 0.5},
        ],
        "goal": [{"name": "speed", "unit": "m/s", "low": 0.0, "high": 8.0, "scale": 0.5}],
        "description": "",
        "seed": 0,
        "outcome": [],
        "exploration": {
            "type": "gaussian", "trust": 4.0, "temperature": [0.02, 0.1, 0.5], "neighbours": 100, "iterations": 3,
            "min_trials": 6, "gate": 1.0, "model": "gp", "candidates": 32, "drift": True,
        },
        "kernel": {"type": "se-ard", "signal_variance": 1.0, "linear_weight": 0.0},
        "budget": 250,
        "regularisation": 1.0,
        "cost_map": "linear",
        "noise_floor": 1e-4,
        "learn_from": "successes",
        "prior_mean": "demonstrations",
        "explore_scale": 1.0,
        "exploration_floor": 0.0,
        "novel": "predict",
        "novelty_limit": 0.9,
        "selector": "anms",
        "refit_every": 0,
        "start": {"type": "space-filling", "count": 0},
        "cost": "measured",
        "skill": "",
    }  # fmt: skip
    np.testing.assert_array_equal(spec.centres, [2.0, 0.0])
    np.testing.assert_array_equal(spec.lengthscales, [1.0, 0.5])
    np.testing.assert_array_equal(spec.bounds, [[0.0], [8.0]])
    np.testing.assert_array_equal(spec.scales, [0.5])


def test_a_declared_outcome_guides_exploration_unless_told_otherwise() -> None:
    spec = TaskSpec.from_dict({**THROW, "outcome": OUTCOME})
    assert spec.exploration.type == "outcome"
    assert [(entry.target, entry.group) for entry in spec.outcome] == [(0.0, "error"), (0.0, "error")]
    told = TaskSpec.from_dict({**THROW, "outcome": OUTCOME, "exploration": {"type": "gaussian"}})
    assert told.exploration.type == "gaussian"
    with pytest.raises(Invalid, match="declared outcome"):
        TaskSpec.from_dict({**THROW, "exploration": {"type": "outcome"}})


settings = st.fixed_dictionaries(
    {},
    optional={
        "description": st.text(max_size=20),
        "seed": st.integers(0, 2**62),
        "budget": st.integers(1, 100_000),
        "regularisation": st.floats(1e-9, 1e6),
        "cost_map": st.sampled_from(["linear", "odds"]),
        "noise_floor": st.floats(1e-12, 1.0),
        "learn_from": st.sampled_from(["successes", "all"]),
        "prior_mean": st.sampled_from(["zero", "demonstrations"]),
        "explore_scale": st.floats(0, 10),
        "exploration_floor": st.floats(0, 10),
        "novel": st.sampled_from(["predict", "refuse"]),
        "novelty_limit": st.floats(0, 1),
        "selector": st.sampled_from(["anms", "full", "freeze"]),
        "refit_every": st.integers(0, 1000),
        "outcome": st.just(OUTCOME),
        "kernel": st.fixed_dictionaries({}, optional={"signal_variance": st.floats(0.1, 10)}),
    },
)


@given(settings)
def test_a_specification_survives_its_dictionary_and_the_wire(given: dict[str, Any]) -> None:
    spec = TaskSpec.from_dict({**THROW, **given})
    assert TaskSpec.from_dict(spec.to_dict()) == spec
    assert TaskSpec.from_dict(unpack(pack(spec.to_dict()))) == spec
    for name, value in given.items():
        if name not in ("outcome", "kernel"):
            assert getattr(spec, name) == value


@given(settings, settings)
def test_differences_are_exactly_the_fields_that_differ(one: dict[str, Any], other: dict[str, Any]) -> None:
    first, second = TaskSpec.from_dict({**THROW, **one}), TaskSpec.from_dict({**THROW, **other})
    mine, theirs = first.to_dict(), second.to_dict()
    expected = {name for name in mine if mine[name] != theirs[name]} - {"description"}
    differences = first.differences(second)
    assert set(differences) == expected
    assert all(differences[name] == [mine[name], theirs[name]] for name in expected)
    assert (first.fingerprint() == second.fingerprint()) == (not expected)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"name": "No Name"}, "task name"),
    ({"state": []}, "1 to 256"),
    ({"state": THROW["state"] * 2}, "names of state must differ"),
    ({"state": [{"name": "x", "low": 1, "high": 1}]}, "low < high"),
    ({"state": [{"name": "x", "low": 0}]}, r"'high' is required in state\[0\]$"),
    ({"state": [{"name": "", "low": 0, "high": 1}]}, "must not be empty"),
    ({"state": [{"name": "x", "low": 0, "high": float("inf")}]}, "finite"),
    ({"state": [{"name": "x", "low": -1e308, "high": 1e308}]}, "lengthscale"),
    ({"state": [{"name": "x", "low": 0, "high": 1, "lengthscale": 0}]}, "lengthscale"),
    ({"state": [5]}, r"state\[0\] must be a map"),
    ({"state": "x"}, "must be a list"),
    ({"goal": [{"name": "g", "low": 2, "high": 1}]}, "low <= high"),
    ({"goal": [{"name": "g", "low": 1, "high": 1, "scale": 0}]}, "scale"),
    ({"outcome": [{"name": "o"}]}, r"'tolerance' is required in outcome\[0\]$"),
    ({"outcome": [{"name": "o", "tolerance": 0}]}, "tolerance"),
    ({"budget": 0}, "budget"),
    ({"budget": 2.5}, "budget"),
    ({"budget": True}, "budget"),
    ({"regularisation": 0}, "regularisation"),
    ({"regularisation": "1"}, "regularisation"),
    ({"regularisation": 10**400}, "regularisation"),
    ({"novelty_limit": 1.5}, "novelty_limit"),
    ({"cost_map": "cubic"}, "'linear', 'odds'"),
    ({"selector": None}, "'anms', 'full', 'freeze'"),
    ({"kernel": {"type": "rbf"}}, "se-ard"),
    ({"kernel": {"linear_weight": 1e308}}, "linear_weight"),
    ({"kernel": 5}, "kernel must be a map"),
    ({"exploration": {"temperature": []}}, "temperature"),
    ({"exploration": "gaussian"}, "exploration must be a map"),
    ({"description": 5}, "description"),
    ({"seed": -1}, "seed"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_a_bad_field_is_refused_by_name(change: dict[str, Any], message: str) -> None:
    with pytest.raises(Invalid, match=message):
        TaskSpec.from_dict({**THROW, **change})


def test_a_goal_of_one_value_only_needs_no_scale() -> None:
    spec = TaskSpec.from_dict({**THROW, "goal": [{"name": "g", "low": 1, "high": 1}]})
    assert spec.goal[0].scale > 0


@pytest.mark.parametrize("missing", ["name", "state", "goal"])
def test_a_missing_field_is_named(missing: str) -> None:
    with pytest.raises(Invalid, match=missing):
        TaskSpec.from_dict({name: value for name, value in THROW.items() if name != missing})


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from(["name", "low", "high", "unit", "type"]), inner, max_size=4)
        ),
        max_leaves=8,
    ),
    st.sampled_from(list(TaskSpec.__dataclass_fields__)),
)
def test_any_value_in_any_field_is_read_or_refused(value: Any, name: str) -> None:
    try:
        spec = TaskSpec.from_dict({**THROW, name: value})
    except Invalid:
        return
    assert TaskSpec.from_dict(spec.to_dict()) == spec


def test_unknown_fields_are_ignored_on_the_wire_and_refused_in_files() -> None:
    assert TaskSpec.from_dict({**THROW, "colour": 1}) == TaskSpec.from_dict(THROW)
    with pytest.raises(Invalid, match="colour"):
        TaskSpec.from_dict({**THROW, "colour": 1}, strict=True)
    every = TaskSpec.from_dict({**THROW, "outcome": OUTCOME})
    assert TaskSpec.from_dict(every.to_dict(), strict=True) == every


@pytest.mark.parametrize(
    ("where", "change"),
    [
        (r"state\[1\]", {"state": [THROW["state"][0], {**THROW["state"][1], "lenghtscale": 1}]}),
        (r"goal\[0\]", {"goal": [{**THROW["goal"][0], "lenghtscale": 1}]}),
        (r"outcome\[0\]", {"outcome": [{**OUTCOME[0], "lenghtscale": 1}]}),
        ("kernel", {"kernel": {"lenghtscale": 1}}),
        ("exploration", {"exploration": {"lenghtscale": 1}}),
    ],
)
def test_a_misspelt_field_of_a_file_is_refused_wherever_it_stands(where: str, change: dict[str, Any]) -> None:
    TaskSpec.from_dict({**THROW, **change})
    with pytest.raises(Invalid, match=f"unknown fields in {where}: lenghtscale; known are "):
        TaskSpec.from_dict({**THROW, **change}, strict=True)


def test_some_settings_may_change_and_the_rest_may_not() -> None:
    spec = TaskSpec.from_dict(THROW)
    changed = spec.with_changes({"budget": 9, "kernel": {"linear_weight": 0.5}})
    assert spec.differences(changed).keys() == {"budget", "kernel"}
    assert (changed.kernel.linear_weight, changed.kernel.signal_variance) == (0.5, 1.0)
    for name in set(spec.to_dict()) - set(CHANGEABLE):
        with pytest.raises(Invalid, match=f"{name} cannot be changed"):
            spec.with_changes({name: spec.to_dict()[name]})
    with pytest.raises(Invalid, match="budget"):
        spec.with_changes({"budget": -1})
    with pytest.raises(Invalid, match="kernel"):
        spec.with_changes({"kernel": 1})


def test_a_specification_is_a_value() -> None:
    data = copy.deepcopy(THROW)
    spec = TaskSpec.from_dict(data)
    data["state"][0]["low"] = -9
    assert spec.state[0].low == 0.0
    with pytest.raises(FrozenInstanceError):
        spec.budget = 3  # type: ignore[misc]  # that is the point
    assert hash(spec) == hash(TaskSpec.from_dict(THROW))


def test_settings_that_the_papers_exploration_does_not_read_are_no_difference() -> None:
    one, other = (TaskSpec.from_dict({**THROW, "exploration": {"trust": trust}}) for trust in (2.0, 4.0))
    assert one.exploration.type == "gaussian"
    assert not one.differences(other)
    outcome = [{"name": "miss", "target": 0.0, "tolerance": 0.1}]
    one, other = (
        TaskSpec.from_dict({**THROW, "outcome": outcome, "exploration": {"type": "outcome", "trust": trust}})
        for trust in (2.0, 4.0)
    )
    assert one.differences(other).keys() == {"exploration"}
