"""Confidence in a rate."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from crkr.client.wilson import wilson_interval


@given(st.integers(1, 2000).flatmap(lambda count: st.tuples(st.integers(0, count), st.just(count))))
def test_the_interval_is_the_one_of_scipy(case: tuple[int, int]) -> None:
    successes, count = case
    expected = binomtest(successes, count).proportion_ci(0.95, "wilson")
    assert wilson_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_nothing_tried_says_nothing() -> None:
    low, high = wilson_interval(0, 0)
    assert math.isclose(low, 0.0)
    assert math.isclose(high, 1.0)
