"""MuJoCo for the shipped skills: scene files, whole motions in one call, and rendering."""

from __future__ import annotations

__all__: list[str] = []
