"""Success by criterion, whatever anybody may have written into a trial's info."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from crkr.client.tally import Tally, stated_epoch, success_by_criterion, wilson_interval


@pytest.mark.parametrize("epoch", [None, "three", True, 1.0, -1, 2**31, [1], {}])
def test_what_is_no_epoch_is_none(epoch: Any) -> None:
    assert stated_epoch({"epoch": epoch}) is None
    assert stated_epoch({}) is None


def test_an_epoch_is_read_as_it_is() -> None:
    assert [stated_epoch({"epoch": epoch}) for epoch in (0, 30, 2**31 - 1)] == [0, 30, 2**31 - 1]


def test_success_is_told_by_criterion_where_the_skill_has_any() -> None:
    assert success_by_criterion(True, {"outcomes": {"paper": True, "strict": np.False_}}) == {
        "paper": True,
        "strict": False,
    }


@pytest.mark.parametrize("outcomes", [None, {}, "x", {"paper": "yes"}, {3: True}])
def test_success_stands_alone_where_there_are_no_criteria(outcomes: Any) -> None:
    assert success_by_criterion(True, {"outcomes": outcomes}) == {"success": True}


@given(st.integers(1, 2000).flatmap(lambda count: st.tuples(st.integers(0, count), st.just(count))))
def test_the_interval_is_the_one_of_scipy(case: tuple[int, int]) -> None:
    successes, count = case
    expected = binomtest(successes, count).proportion_ci(0.95, "wilson")
    assert wilson_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_nothing_tried_says_nothing() -> None:
    low, high = wilson_interval(0, 0)
    assert math.isclose(low, 0.0)
    assert math.isclose(high, 1.0)


MET = st.dictionaries(st.sampled_from(["paper", "strict", "success"]), st.booleans())


@given(st.lists(MET, max_size=30))
def test_a_rate_is_the_mean_over_the_trials_that_named_the_criterion(trials: list[dict[str, bool]]) -> None:
    tally = Tally()
    for met in trials:
        tally.add(met)
    assert tally.trials == len(trials)
    for name in ("paper", "strict", "success"):
        said = [met[name] for met in trials if name in met]
        assert tally.rate(name) == pytest.approx(np.mean(said) if said else math.nan, nan_ok=True)
        assert tally.interval(name) == wilson_interval(sum(said), len(said))
    assert set(tally.rates()) == set(tally.intervals()) == {name for met in trials for name in met}


@given(st.lists(MET, max_size=20), st.lists(MET, max_size=20))
def test_a_trial_taken_back_was_never_counted(stay: list[dict[str, bool]], go: list[dict[str, bool]]) -> None:
    tally, other = Tally(), Tally()
    for met in (*go, *stay):
        tally.add(met)
    for met in go:
        tally.remove(met)
    for met in stay:
        other.add(met)
    assert (tally.trials, tally.rates(), tally.intervals()) == (other.trials, other.rates(), other.intervals())
