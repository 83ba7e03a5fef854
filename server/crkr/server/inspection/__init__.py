"""Inspection of an existing log: verification, seals, and stored runs."""

from __future__ import annotations

__all__: list[str] = []
