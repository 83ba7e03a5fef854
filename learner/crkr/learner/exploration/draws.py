"""The random numbers of exploration, a pure function of task and trial: a repeated question gets the same answer.

The p uniforms of a trial come from SHAKE-128 [FIPS202] of 24 bytes: the task's seed as a little-endian unsigned 64-bit
integer (modulo 2^64) and the trial's id (16 bytes, in network order). Each 8 bytes of output, read as a little-endian
unsigned integer x, give one uniform ((x >> 12) + 1/2) / 2^52. That is strictly inside (0, 1) and exact in float64.

Uniforms become draws from a normal distribution truncated at the bounds, exact for bounds at any distance from the
mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import shake_128
from typing import Final
from uuid import UUID

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from crkr.protocol import Array

__all__ = ["draw_ids", "space_filling", "truncated_normal", "uniforms"]

_MOST: Final = 1024  # trials after which the sequence repeats, as skipping far ahead takes time


def uniforms(seed: int, trial_ids: Sequence[UUID], size: int) -> Array:
    """(b, size) numbers strictly inside (0, 1), a row for each of the b trials."""
    prefix = (seed % 2**64).to_bytes(8, "little")
    stream = b"".join(shake_128(prefix + trial_id.bytes).digest(8 * size) for trial_id in trial_ids)
    words = np.frombuffer(stream, dtype="<u8").reshape(len(trial_ids), size)
    return ((words >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52


def draw_ids(namespace: str, count: int) -> list[UUID]:
    """`count` version 8 UUIDs [RFC9562], SHAKE-128 of the namespace."""
    octets = np.frombuffer(shake_128(namespace.encode()).digest(16 * count), dtype=np.uint8).reshape(-1, 16).copy()
    octets[:, 6] = octets[:, 6] & 0x0F | 0x80
    octets[:, 8] = octets[:, 8] & 0x3F | 0x80
    return [UUID(bytes=one) for one in octets.view("V16")[:, 0].tolist()]


def truncated_normal(mean: Array, sigma: Array, low: Array, high: Array, uniform: Array) -> Array:
    """The quantile `uniform` of N(mean, sigma^2) restricted to [low, high]; shapes broadcast.

    Probabilities are logarithms and measured from the nearer tail, which stays exact for bounds 1000 sigma away from
    the mean. A zero sigma gives the mean, clipped to the bounds.

    Args:
        mean: Mean of the untruncated normal.
        sigma: Its standard deviation, >= 0.
        low: Smallest value, <= high.
        high: Largest value.
        uniform: Quantile, strictly inside (0, 1).
    """
    width = np.maximum(sigma, np.finfo(np.float64).tiny)
    with np.errstate(over="ignore"):
        a, b = (low - mean) / width, (high - mean) / width
    q, tail = np.log(uniform), np.log1p(-uniform)
    with np.errstate(divide="ignore", invalid="ignore"):
        below = np.logaddexp(log_ndtr(a) + tail, log_ndtr(b) + q)
        above = np.logaddexp(log_ndtr(-a) + tail, log_ndtr(-b) + q)
        standard = np.where(below < above, ndtri_exp(below), -ndtri_exp(above))
        drawn = mean + sigma * standard
    # NaN only where a bound is out of log_ndtr's range: the draw is then at that bound.
    return np.minimum(np.maximum(np.where(np.isnan(drawn), mean, drawn), low), high)


def space_filling(seed: int, ids: Sequence[UUID], tried: int, low: Array, high: Array) -> Array:
    """(b, p) goals that fill the space between the bounds, for a task that knows nothing yet.

    A scrambled Halton sequence [Owen2017], indexed by the number of earlier trials. The trial's id shifts each point by
    a fraction of the point distance, so that workers that ask at the same moment try different goals.

    Args:
        seed: The task's.
        ids: One for each goal.
        tried: Number of earlier trials.
        low: (p,) lowest goals allowed.
        high: (p,) highest goals allowed.
    """
    from scipy.stats import qmc  # slow to import, and few tasks need it

    b, p, first = len(ids), len(low), tried % _MOST
    sequence = qmc.Halton(p, scramble=True, rng=np.random.default_rng(seed % 2**64))
    points = sequence.fast_forward(first).random(b)
    apart = (first + 1 + np.arange(b)) ** (-1.0 / p)
    points = (points + apart[:, None] * (uniforms(seed, ids, p) - 0.5)) % 1.0
    return np.asarray(np.clip(low * (1.0 - points) + high * points, low, high))
