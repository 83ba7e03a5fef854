"""A worker process: the trial loop and its link to the supervisor."""

from __future__ import annotations

__all__: list[str] = []
