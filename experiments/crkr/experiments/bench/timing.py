"""Times of several callables, taken in turns, so that what else the machine does falls on all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from crkr.protocol import Array

__all__ = ["in_turns", "spell"]


def spell(call: Callable[[], Any], count: int) -> Array:
    """(count,) times of consecutive calls [s]."""
    times = np.empty(count)
    for index in range(count):
        started = time.perf_counter()
        call()
        times[index] = time.perf_counter() - started
    return times


def in_turns(calls: dict[str, Callable[[], Any]], rounds: int, count: int) -> dict[str, Array]:
    """Name -> (rounds * count,) times [s]; every round takes a spell of each. One short spell before is not counted."""
    for call in calls.values():
        spell(call, min(count, 20))
    found: dict[str, list[Array]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            found[name].append(spell(call, count))
    return {name: np.concatenate(spells) for name, spells in found.items()}
