"""Rules for the active set beside ANMS, and what each learns with the same trials."""

from __future__ import annotations

__all__: list[str] = []
