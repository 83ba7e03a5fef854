from __future__ import annotations

import numpy as np
import pytest

from crkr.learner import saturated_cost
from crkr.protocol import Invalid


def test_cost_is_zero_at_the_target_and_one_far_away() -> None:
    assert saturated_cost(np.zeros(3), 0.06) == 0.0
    assert saturated_cost(np.array([1e200, 0.0, 0.0]), 0.06) == 1.0


def test_cost_at_one_length_is_one_minus_exp_of_minus_a_half() -> None:
    assert saturated_cost(np.array([0.0, 0.06]), 0.06) == pytest.approx(1 - np.exp(-0.5))


def test_cost_near_the_target_is_quadratic() -> None:
    assert saturated_cost(np.array([6e-8]), 0.06) == pytest.approx(0.5e-12, rel=1e-9)


def test_a_batch_of_errors_gives_a_batch_of_costs() -> None:
    errors = np.random.default_rng(0).normal(size=(4, 5, 3))
    costs = saturated_cost(errors, 0.5)
    assert costs.shape == (4, 5)
    assert costs[2, 3] == saturated_cost(errors[2, 3], 0.5)


@pytest.mark.parametrize("length", [0.0, -1.0, np.nan, np.inf])
def test_a_length_that_is_not_positive_is_refused(length: float) -> None:
    with pytest.raises(Invalid, match="length must be a positive number of metres"):
        saturated_cost(np.zeros(2), length)


def test_an_error_that_is_not_finite_is_refused() -> None:
    with pytest.raises(Invalid, match="error must be finite"):
        saturated_cost(np.array([np.nan]), 1.0)
