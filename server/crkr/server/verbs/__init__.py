"""What each verb of the protocol does."""

from __future__ import annotations

__all__: list[str] = []
