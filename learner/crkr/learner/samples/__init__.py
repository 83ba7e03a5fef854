"""Every reported trial, in columns."""

from __future__ import annotations

__all__: list[str] = []
