"""Everything that imports Zenoh: sessions, queries, subscriptions and liveliness tokens."""

from __future__ import annotations

__all__: list[str] = []
