"""Movement primitives that any skill can use: a quadratic program for strokes."""

from __future__ import annotations

__all__: list[str] = []
