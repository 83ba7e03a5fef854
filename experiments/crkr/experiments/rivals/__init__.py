"""What one would use instead of crkr, each behind the same interface and on the same trials."""

from __future__ import annotations

__all__: list[str] = []
