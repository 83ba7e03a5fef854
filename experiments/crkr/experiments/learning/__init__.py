"""Whole runs of learning without a server, over many seeds."""

from __future__ import annotations

__all__: list[str] = []
