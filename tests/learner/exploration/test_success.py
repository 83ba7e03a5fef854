"""Success probabilities beside a general optimiser's, and on data whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from crkr.learner.exploration.success import SuccessCurve, SuccessRate
from crkr.protocol import Array

PRIOR, SPREAD = np.array([2.0, 1.0]), 1.5


def flips(count: int, seed: int = 0) -> tuple[Array, NDArray[np.bool_]]:
    rng = np.random.default_rng(seed)
    features = np.stack([np.ones(count), -rng.exponential(3.0, count)], axis=1)
    return features, np.asarray(rng.uniform(size=count) < expit(features @ [1.0, 0.7]))


def test_the_curve_maximises_its_posterior() -> None:
    features, success = flips(80)
    signs = np.where(success, 1.0, -1.0)

    def loss(w: Array) -> float:
        return float(np.logaddexp(0, -signs * (features @ w)).sum() + ((w - PRIOR) ** 2).sum() / (2 * SPREAD**2))

    curve = SuccessCurve.fit(features, success, PRIOR, SPREAD)
    best = minimize(loss, PRIOR).fun
    assert loss(curve.weights) <= best + 1e-9


def test_without_trials_the_curve_is_the_prior() -> None:
    curve = SuccessCurve.fit(np.zeros((0, 2)), np.zeros(0, dtype=np.bool_), PRIOR, SPREAD)
    np.testing.assert_allclose(curve.at(np.array([1.0, -3.0])), expit(-1.0))


def test_what_is_said_often_comes_true() -> None:
    features, success = flips(4000)
    told = SuccessCurve.fit(features[:2000], success[:2000], PRIOR, SPREAD).at(features[2000:])
    for low in (0.0, 0.3, 0.6):
        some = (told >= low) & (told < low + 0.3)
        assert abs(told[some].mean() - success[2000:][some].mean()) < 0.07


def test_absurd_features_give_probabilities() -> None:
    features = np.array([[1.0, -1e300], [1.0, np.nan], [1.0, np.inf], [1.0, 0.0]])
    curve = SuccessCurve.fit(features, np.array([True, False, True, False]), PRIOR, SPREAD)
    assert ((curve.at(features) >= 0) & (curve.at(features) <= 1)).all()


def rate_of(states: Array, success: Array) -> SuccessRate:
    return SuccessRate(lambda: (states, success))


def test_the_rate_is_local_and_falls_back_on_all_trials() -> None:
    Z = np.concatenate([np.zeros((50, 2)), np.full((50, 2), 8.0)])
    rate = rate_of(Z, np.repeat([1.0, 0.0], 50))
    near, there, far = rate.at(np.array([[0.0, 0.0], [8.0, 8.0], [400.0, -400.0]]))
    assert near > 0.95
    assert there < 0.05
    assert far == 0.5
    assert rate.at(np.zeros(2)) == near


@pytest.mark.parametrize("scale", [1.0, 40.0, 1e20])
def test_the_rate_of_one_state_is_that_among_many(scale: float) -> None:
    rng = np.random.default_rng(5)
    rate, states = rate_of(scale * rng.normal(size=(30, 3)), rng.random(30)), scale * rng.normal(size=(20, 3))
    assert np.allclose([rate.at(one) for one in states], rate.at(states), rtol=0.0, atol=1e-9)


def test_the_rate_is_a_probability_where_all_succeeded() -> None:
    rng = np.random.default_rng(1)
    for count in range(1, 60):
        rate = rate_of(rng.normal(size=(count, 2)), np.ones(count))
        assert (rate.at(rng.normal(size=(50, 2))) <= 1.0).all()
