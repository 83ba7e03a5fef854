"""A kernel matrix put together of kept and new rows, beside one made at once: the same bits."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crkr.learner import Kernel, Learner, Regression
from crkr.learner.kernel_matrix import KernelMatrix
from crkr.protocol import Array, TaskSpec, Trial


def states(seed: int, count: int, d: int) -> Array:
    """Near and far ones, so that entries reach from 1 down to nothing."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.normal(size=(count, d)) * 10.0 ** rng.uniform(-3, 2, (count, 1)))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    d=st.integers(1, 8),
    variance=st.sampled_from([1.0, 0.3, 7.0]),
    linear=st.sampled_from([0.0, 0.0, 0.4]),
)
def test_whatever_is_exchanged_the_matrix_has_the_bits_of_one_made_at_once(
    seed: int, d: int, variance: float, linear: float
) -> None:
    rng = np.random.default_rng(seed)
    everything = states(seed, 400, d)
    kernel, matrix = Kernel(np.zeros(d), np.ones(d), variance, linear), KernelMatrix()
    rows = np.sort(rng.choice(400, int(rng.integers(1, 300)), replace=False))
    for _ in range(12):
        if rng.uniform() < 0.1:
            kernel = Kernel(np.zeros(d), np.ones(d), variance * float(rng.uniform(0.5, 2)), linear)
        Z = everything[rows]
        K = matrix.of(rows, kernel, Z)
        assert K.tobytes() == kernel.matrix(Z, Z).tobytes()
        assert K.tobytes() == K.T.tobytes() or linear
        K[:] = np.nan  # the caller's, as when it is factored
        kept = rng.choice(rows, len(rows) - min(int(rng.integers(4)), len(rows) - 1), replace=False)
        rows = np.union1d(kept, rng.integers(0, 400, int(rng.integers(4))))


@pytest.mark.parametrize("m", [128, 250, 1000])
def test_entries_of_kept_samples_are_not_made_anew(m: int) -> None:
    kernel, matrix, everything = Kernel(np.zeros(3), np.ones(3), 1.0), KernelMatrix(), states(0, m + 1, 3)
    rows, changed = np.delete(np.arange(m + 1), m // 3), m - 1
    before = matrix.of(np.arange(m), kernel, everything[:m])
    elsewhere = everything[rows] + 100.0  # which only a new row is made of
    K = matrix.of(rows, kernel, elsewhere)
    kept = np.delete(np.arange(m), m // 3)
    np.testing.assert_array_equal(K[:changed, :changed], before[np.ix_(kept, kept)])
    np.testing.assert_array_equal(K[changed], kernel.matrix(elsewhere[changed:], elsewhere)[0])
    np.testing.assert_array_equal(matrix.of(rows, kernel, everything[rows]), K, "the same samples again")


def test_a_factor_has_the_same_bits_whatever_path_led_to_its_samples() -> None:
    rng = np.random.default_rng(1)
    everything, goals, noise = states(2, 300, 4), rng.normal(size=(300, 2)), rng.uniform(1e-4, 1, 300)
    kernel, matrix = Kernel(np.zeros(4), np.ones(4), 1.3), KernelMatrix()
    for count in range(1, 300, 7):
        rows = np.sort(rng.choice(count, min(count, 200), replace=False)) if count % 3 else np.arange(count)[-200:]
        kept = Regression.fit(kernel, everything[rows], goals[rows], noise[rows], matrix=partial(matrix.of, rows))
        fresh = Regression.fit(kernel, everything[rows], goals[rows], noise[rows])
        assert kept.L.tobytes() == fresh.L.tobytes()
        assert kept.W.tobytes() == fresh.W.tobytes()


def test_a_matrix_that_does_not_factor_is_asked_for_again() -> None:
    kernel, matrix = Kernel(np.zeros(1), np.ones(1), 1.0), KernelMatrix()
    Z = np.repeat(np.linspace(0, 1, 100), 2)[:, None]
    rows, Y, noise = np.arange(200), np.ones((200, 1)), np.full(200, 1e-300)
    kept = Regression.fit(kernel, Z, Y, noise, matrix=partial(matrix.of, rows))
    assert kept.floor > 1e-300
    assert kept.L.tobytes() == Regression.fit(kernel, Z, Y, noise).L.tobytes()


def test_a_learner_that_exchanged_samples_one_by_one_has_the_model_of_one_that_learned_all_at_once(
    make_spec: Callable[..., TaskSpec],
) -> None:
    rng = np.random.default_rng(3)
    spec = make_spec(3, 2, budget=150)
    states, goals, costs = rng.uniform(-2, 2, (400, 3)), rng.uniform(-1, 1, (400, 2)), rng.uniform(size=400)
    ids = [UUID(bytes=rng.bytes(16)) for _ in range(400)]
    trials = [Trial(*values, True) for values in zip(ids, states, goals, costs.tolist(), strict=True)]
    steady, quick = Learner(spec), Learner(spec)
    for seq, trial in enumerate(trials, 2):
        steady.apply_trials([seq], [trial])
    with quick.bulk():
        quick.apply_trials(range(2, 402), trials)
    ours, theirs = steady.model.regression, quick.model.regression
    assert ours is not None
    assert theirs is not None
    for name in ("Z", "noise", "L", "W"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
