"""Pictures and films of trials and policies."""

from __future__ import annotations

__all__: list[str] = []
