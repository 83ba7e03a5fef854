"""The task log on PostgreSQL, which a second server can take over."""

from __future__ import annotations

__all__: list[str] = []
