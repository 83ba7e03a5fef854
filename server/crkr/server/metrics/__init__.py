"""Durations, counts and the Prometheus endpoint."""

from __future__ import annotations

__all__: list[str] = []
