"""Factors made in slices are factors, and other threads run meanwhile."""

import threading

import numpy as np
import pytest
from scipy.linalg import cholesky

from crkr.learner.cholesky import WHOLE, factor, solve, solve_lower
from crkr.protocol import Array


def positive_definite(m: int) -> Array:
    Z = np.random.default_rng(m).normal(size=(m, 3))
    K: Array = np.exp(-0.5 * ((Z[:, None] - Z) ** 2).sum(axis=2))
    K.flat[:: m + 1] += 0.1
    return K


@pytest.mark.parametrize("m", [1, 40, WHOLE, WHOLE + 1, WHOLE + 300])
def test_a_factor_is_lapacks_whether_or_not_it_is_made_in_slices(m: int) -> None:
    K = positive_definite(m)
    L, failed = factor(K.T.copy(order="F"))
    assert failed == 0
    assert not np.triu(L, 1).any()
    np.testing.assert_allclose(L, cholesky(K, lower=True), rtol=1e-10, atol=1e-12)
    B = np.random.default_rng(0).normal(size=(m, 4))
    np.testing.assert_allclose(L @ solve_lower(L, B.copy(order="F")), B, atol=1e-11)
    np.testing.assert_allclose(K @ solve(L, B), B, atol=1e-10)


@pytest.mark.parametrize("m", [40, WHOLE + 300])
def test_a_matrix_that_is_not_positive_definite_is_told_by_its_first_bad_minor(m: int) -> None:
    K = positive_definite(m)
    K[m - 10, m - 10] = -1.0
    assert factor(K.T.copy(order="F"))[1] == m - 9
    K[m - 10, m - 10] = np.nan
    assert factor(K.T.copy(order="F"))[1] == m - 9


def test_another_thread_has_many_turns_while_a_large_matrix_is_factored() -> None:
    K, turns, done = positive_definite(2500).T.copy(order="F"), 0, threading.Event()

    def factored() -> None:
        factor(K)
        done.set()

    thread = threading.Thread(target=factored)
    thread.start()
    while not done.wait(1e-4):
        turns += 1
    thread.join()
    assert turns >= 10  # one call of LAPACK lets nobody in
