"""Pictures and films of trials, for every skill that offers shapes and motion."""

from __future__ import annotations

__all__: list[str] = []
