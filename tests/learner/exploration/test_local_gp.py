"""Local regression beside the textbook's formulas with dense inverses, and beside finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from crkr.learner.exploration.local_gp import LocalGP, StepKernel
from crkr.protocol import Array

R, P, K, M = 7, 4, 30, 3
KERNEL = StepKernel(constant=9.0, linear=4.0, bend=2.0, reach=1.5, noise=0.3)


def neighbours(b: int, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(b, K, R)), rng.normal(size=(b, K, M))


def k(A: Array, B: Array) -> Array:
    squared = ((A[:, None] - B[None]) ** 2).sum(axis=2)
    bend = KERNEL.bend * np.exp(-squared / (2 * KERNEL.reach**2))
    return np.asarray(KERNEL.constant + KERNEL.linear * A @ B.T + bend)


def whole(steps: Array) -> Array:
    """Steps (c, P) of the goal as steps of the whole trial."""
    return np.concatenate([np.zeros((len(steps), R - P)), steps], axis=1)


def test_expectations_and_variances_are_the_textbooks() -> None:
    [D], [Y] = neighbours(1)
    steps = np.random.default_rng(1).normal(size=(5, P))
    noise = np.random.default_rng(2).uniform(0.1, 1.0, K)
    inverse = np.linalg.inv(k(D, D) + np.diag(noise))
    cross = k(whole(steps), D)
    amplitude = (np.einsum("km,kl,lm->m", Y, inverse, Y) + 10) / (K + 10)
    variance = k(whole(steps), whole(steps)).diagonal() - np.einsum("ck,kl,cl->c", cross, inverse, cross)
    fit = LocalGP.fit(KERNEL, D[None], Y[None], P, noise[None])
    mean, sd2 = fit.at(steps[None])
    np.testing.assert_allclose(mean[0], cross @ inverse @ Y, rtol=1e-9)
    np.testing.assert_allclose(fit.mean(steps[None]), mean, rtol=1e-12)
    np.testing.assert_allclose(sd2[0], (variance + KERNEL.noise)[:, None] * amplitude, rtol=1e-8)


def test_a_changed_robot_does_what_it_did_plus_a_process_of_its_own() -> None:
    [D], [Y] = neighbours(1)
    steps, former = np.random.default_rng(1).normal(size=(5, P)), 12
    as_it_is = np.arange(K) < K - former
    K_both = k(D, D) + KERNEL.change * np.where(np.outer(as_it_is, as_it_is), k(D, D), 0.0)
    inverse = np.linalg.inv(K_both + KERNEL.noise * np.eye(K))
    cross = k(whole(steps), D) * (1.0 + KERNEL.change * as_it_is)
    prior = (1.0 + KERNEL.change) * k(whole(steps), whole(steps)).diagonal()
    amplitude = (np.einsum("km,kl,lm->m", Y, inverse, Y) + 10) / (K + 10)
    variance = prior - np.einsum("ck,kl,cl->c", cross, inverse, cross)
    mean, sd2 = LocalGP.fit(KERNEL, D[None], Y[None], P, former=former).at(steps[None])
    np.testing.assert_allclose(mean[0], cross @ inverse @ Y, rtol=1e-9)
    np.testing.assert_allclose(sd2[0], (variance + KERNEL.noise)[:, None] * amplitude, rtol=1e-8)


@pytest.mark.parametrize("former", [0, 12, K])
def test_slopes_are_the_differences_of_the_expectations(former: int) -> None:
    D, Y = neighbours(3)
    fit = LocalGP.fit(KERNEL, D, Y, P, former=former)
    at, h = np.random.default_rng(3).normal(size=(3, P)), 1e-5
    mean, variance, slope = fit.line(at)
    again, slope_of = fit.tangent(at)
    for mine, theirs in zip((mean, variance, again, slope_of()), (*fit.at(at[:, None]), mean, slope), strict=True):
        np.testing.assert_allclose(mine, theirs.reshape(mine.shape), rtol=1e-9)
    for axis in range(P):
        step = h * np.eye(P)[axis]
        change = fit.mean((at + step)[:, None]) - fit.mean((at - step)[:, None])
        np.testing.assert_allclose(slope[:, :, axis], change[:, 0] / (2 * h), rtol=1e-5, atol=1e-6)


def test_a_straight_line_is_found_wherever_it_leads() -> None:
    rng = np.random.default_rng(4)
    D, slope = rng.normal(size=(1, 200, R)), rng.normal(size=(R, M))
    kernel = StepKernel(constant=900.0, linear=100.0, bend=1e-3, reach=5.0, noise=1e-6)
    fit = LocalGP.fit(kernel, D, D @ slope + 3.0, P)
    far = 30 * rng.normal(size=(1, 6, P))
    np.testing.assert_allclose(fit.mean(far)[0], whole(far[0]) @ slope + 3.0, rtol=1e-3, atol=1e-2)


def test_a_point_has_the_same_bits_in_any_company() -> None:
    D, Y = neighbours(9)
    steps = np.random.default_rng(5).normal(size=(9, 6, P))
    together = LocalGP.fit(KERNEL, D, Y, P)
    for row in range(9):
        alone = LocalGP.fit(KERNEL, D[row : row + 1], Y[row : row + 1], P)
        some = together.of(np.array([row]))
        for one in (alone, some):
            its, all_its = one.at(steps[row : row + 1]), together.at(steps)
            lines, all_lines = one.line(steps[row : row + 1, 0]), together.line(steps[:, 0])
            for mine, theirs in zip((*its, *lines), (*all_its, *all_lines), strict=True):
                assert mine[0].tobytes() == theirs[row].tobytes()


@pytest.mark.parametrize("scale", [0.0, 1e-200, 1e3, 1e50])
@pytest.mark.parametrize("size", [0.0, 1.0, 1e6])
def test_absurd_neighbours_give_numbers(scale: float, size: float) -> None:
    D, Y = neighbours(2)
    D[0] *= scale
    D[1, :3] *= scale
    fit = LocalGP.fit(KERNEL, D, size * Y, P)
    mean, variance = fit.at(np.random.default_rng(6).normal(size=(2, 8, P)))
    assert np.isfinite(mean).all()
    assert (variance > 0).all()
    assert np.isfinite(variance).all()
    assert all(np.isfinite(part).all() for part in fit.line(np.ones((2, P))))
