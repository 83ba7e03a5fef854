"""Compares the newest trials with their predictions, which workers store in `info["predicted"]`."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Final, final

import numpy as np

from crkr.protocol import Array, Trial

__all__ = ["EXPECTED", "HELD", "OBSERVED", "PredictionRecord"]

NEWEST: Final = 200  # trials looked at
EXPECTED: Final = "expected success"
OBSERVED: Final = "observed success"
HELD: Final = "outcomes within their 90 % interval"
_NORMAL_90: Final = 1.6449


@final
class PredictionRecord:
    """Predicted and observed success, and how many outcomes were within their interval, over the newest trials."""

    def __init__(self) -> None:
        self._chances: deque[tuple[float, bool]] = deque(maxlen=NEWEST)
        self._entries: deque[tuple[int, int]] = deque(maxlen=NEWEST)  # outcomes within, and outcomes observed
        self._expected = 0.0
        self._successes = self._within = self._observed = 0

    def add(self, trial: Trial) -> None:
        """Counts a trial; one without a prediction, or with one that cannot be read, is left out."""
        predicted = trial.info.get("predicted")
        if not isinstance(predicted, Mapping):
            return
        chance = predicted.get("success")
        if isinstance(chance, int | float) and 0.0 <= chance <= 1.0:
            self._add_chance(float(chance), trial.success)
        if trial.outcome is not None and trial.kind != "failed":
            self._add_outcome(trial.outcome, predicted)

    def shares(self) -> dict[str, float]:
        """Known shares by name."""
        known = {}
        if self._chances:
            known[EXPECTED] = self._expected / len(self._chances)
            known[OBSERVED] = self._successes / len(self._chances)
        if self._observed:
            known[HELD] = self._within / self._observed
        return known

    def _add_chance(self, chance: float, success: bool) -> None:
        if len(self._chances) == NEWEST:
            gone, won = self._chances[0]
            self._expected -= gone
            self._successes -= won
        self._chances.append((chance, success))
        self._expected = max(self._expected + chance, 0.0)
        self._successes += success

    def _add_outcome(self, outcome: Array, predicted: Mapping[str, Any]) -> None:
        mean, deviation = (_numbers(predicted.get(name), len(outcome)) for name in ("outcome", "sd"))
        if mean is None or deviation is None:
            return
        with np.errstate(over="ignore", invalid="ignore"):
            off, half = np.abs(outcome - mean), _NORMAL_90 * deviation
        seen = int(np.count_nonzero(~np.isnan(off + half)))
        within = int(np.count_nonzero(off <= half))
        if len(self._entries) == NEWEST:
            gone, before = self._entries[0]
            self._within -= gone
            self._observed -= before
        self._entries.append((within, seen))
        self._within += within
        self._observed += seen


def _numbers(value: object, count: int) -> Array | None:
    """(count,) numbers, NaN among them; None for anything else."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if numbers.shape == (count,) else None
