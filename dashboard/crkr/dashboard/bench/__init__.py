"""`crkr bench dashboard`: what watching costs, beside the same program that draws nothing."""

from __future__ import annotations

__all__: list[str] = []
