"""Judging a policy: contexts, epochs, assessments and the history of a run."""

from __future__ import annotations

__all__: list[str] = []
