"""Draws from a normal distribution cut off at hard bounds, exact however far the bounds are from the mean."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from crkr.protocol import Array

__all__ = ["truncated_normal"]


def truncated_normal(mean: Array, sigma: Array, low: Array, high: Array, uniform: Array) -> Array:
    """The quantile `uniform` of N(mean, sigma^2) restricted to [low, high]; shapes broadcast.

    Probabilities are kept as logarithms and counted from the nearer tail, so that bounds 12 or 1000 sigma away from the
    mean still give the right distribution. A zero sigma gives the mean, moved to the nearer bound.

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
    # Only where a bound is beyond the reach of log_ndtr is there no number: the draw is then at that bound.
    return np.minimum(np.maximum(np.where(np.isnan(drawn), mean, drawn), low), high)
