"""Benchmarks of the learner and of simulated trials."""

from __future__ import annotations

__all__: list[str] = []
