"""The ball: flight, bounces, impacts and launches."""

from __future__ import annotations

__all__: list[str] = []
