"""Zenoh queries: received, queued, answered exactly once or refused."""

from __future__ import annotations

__all__: list[str] = []
