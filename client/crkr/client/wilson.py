"""How sure a success rate is."""

from __future__ import annotations

import math
from typing import Final

__all__ = ["wilson_interval"]

Z95: Final = 1.959963984540054  # the 97.5 % point of the standard normal


def wilson_interval(successes: int, count: int, z: float = Z95) -> tuple[float, float]:
    """Wilson's score interval for a proportion  [Wilson1927].

    Args:
        successes: How many succeeded.
        count: Of how many; none gives (0, 1).
        z: Standard normal quantile, the default for 95 %.
    """
    if count == 0:
        return 0.0, 1.0
    rate, shrink = successes / count, 1.0 + z * z / count
    centre = (rate + z * z / (2 * count)) / shrink
    half = z / shrink * math.sqrt(rate * (1.0 - rate) / count + z * z / (4 * count * count))
    return max(0.0, centre - half), min(1.0, centre + half)
