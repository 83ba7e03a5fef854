"""A task's specification: its axes, its settings, and the checks on both."""

from __future__ import annotations

__all__: list[str] = []
