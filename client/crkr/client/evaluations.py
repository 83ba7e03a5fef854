"""What a trial's info says about its epoch and its success, read alike by everything that counts a log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

__all__ = ["stated_epoch", "success_by_criterion"]

LARGEST_EPOCH: Final = 2**31 - 1


def stated_epoch(info: Mapping[str, Any]) -> int | None:
    """The epoch that a trial says it belongs to, or None.

    An evaluation without one was made by hand: it is no point of the learning curve. What is not a whole number from 0
    to 2**31 - 1 is read as none, because anybody may write to the log.
    """
    epoch = info.get("epoch")
    return epoch if type(epoch) is int and 0 <= epoch <= LARGEST_EPOCH else None


def success_by_criterion(success: bool, info: Mapping[str, Any]) -> dict[str, bool]:
    """Success by every criterion that the skill has: the truth values in `info["outcomes"]`, else just "success".

    Args:
        success: What the skill chose to learn from.
        info: The trial's.
    """
    outcomes = info.get("outcomes")
    named = outcomes.items() if isinstance(outcomes, Mapping) else ()
    met = {name: bool(value) for name, value in named if isinstance(name, str) and isinstance(value, bool | np.bool_)}
    return met or {"success": success}
