"""How a swing is executed: contact, hybrid and analytic."""

from __future__ import annotations

__all__: list[str] = []
