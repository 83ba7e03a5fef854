"""The process that starts workers, hands out trials and notices what is lost."""

from __future__ import annotations

__all__: list[str] = []
