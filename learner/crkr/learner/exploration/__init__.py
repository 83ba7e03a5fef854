"""From a distribution over goals to the goal to execute, with or without measured outcomes."""

from __future__ import annotations

__all__: list[str] = []
