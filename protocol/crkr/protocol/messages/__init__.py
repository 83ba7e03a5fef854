"""Requests, answers and publications as values that are checked once."""

from __future__ import annotations

__all__: list[str] = []
