"""The client's subcommands of `crkr`; the other parts bring their own."""

from __future__ import annotations

__all__: list[str] = []
