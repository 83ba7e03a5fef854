"""Reports that are kept in a file until the server has them."""

from __future__ import annotations

__all__: list[str] = []
