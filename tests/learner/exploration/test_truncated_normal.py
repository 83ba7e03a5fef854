from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest, truncnorm

from crkr.learner import truncated_normal


@pytest.mark.parametrize(
    ("mean", "sigma", "low", "high"),
    [
        (0.0, 1.0, -1.0, 2.0),
        (0.3, 0.01, 0.0, 1.0),
        (5.0, 0.5, -1.0, 1.0),
        (-12.0, 1.0, 0.0, 1.0),  # 12 sigma below the bounds
        (13.0, 1.0, 0.0, 1.0),  # 12 sigma above
        (1200.0, 1.0, 0.0, 1.0),
        (0.0, 1e6, -1.0, 1.0),  # nearly uniform
        (0.0, 1.0, -40.0, -9.0),
    ],
)
def test_draws_have_the_right_distribution(mean: float, sigma: float, low: float, high: float) -> None:
    uniform = np.random.default_rng(0).uniform(size=4000)
    drawn = truncated_normal(np.array(mean), np.array(sigma), np.array(low), np.array(high), uniform)
    assert np.isfinite(drawn).all()
    assert (drawn >= low).all()
    assert (drawn <= high).all()
    reference = truncnorm((low - mean) / sigma, (high - mean) / sigma, mean, sigma)
    assert kstest(drawn, reference.cdf).pvalue > 1e-3


def test_the_quantile_is_that_of_scipy() -> None:
    uniform = np.linspace(0.001, 0.999, 50)
    ours = truncated_normal(np.array(0.2), np.array(0.7), np.array(-1.0), np.array(0.5), uniform)
    np.testing.assert_allclose(ours, truncnorm(-1.2 / 0.7, 0.3 / 0.7, 0.2, 0.7).ppf(uniform), rtol=1e-9)


def test_a_draw_is_its_mirror_image_when_everything_is_mirrored() -> None:
    uniform = np.linspace(0.01, 0.99, 33)
    right = truncated_normal(np.array(-9.0), np.array(1.0), np.array(0.0), np.array(2.0), uniform)
    left = truncated_normal(np.array(9.0), np.array(1.0), np.array(-2.0), np.array(0.0), 1 - uniform)
    np.testing.assert_allclose(right, -left, rtol=1e-9)


def test_without_spread_the_draw_is_the_mean_within_the_bounds() -> None:
    means = np.array([-3.0, 0.25, 7.0])
    drawn = truncated_normal(means, np.zeros(3), np.full(3, -1.0), np.full(3, 1.0), np.full(3, 0.3))
    np.testing.assert_array_equal(drawn, [-1.0, 0.25, 1.0])


numbers = st.floats(-1e12, 1e12)


@given(numbers, st.floats(0.0, 1e12), numbers, st.floats(0.0, 1e12), st.floats(2.0**-53, 1 - 2.0**-53))
def test_every_draw_is_finite_and_inside(mean: float, sigma: float, low: float, width: float, uniform: float) -> None:
    high = low + width
    drawn = truncated_normal(np.array(mean), np.array(sigma), np.array(low), np.array(high), np.array(uniform))
    assert low <= drawn <= high
