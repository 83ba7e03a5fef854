"""Looking at a log that is there: verification, seals, and stored runs."""

from __future__ import annotations

__all__: list[str] = []
