"""The frame of the `crkr` command: subcommands, options, output and errors."""

from __future__ import annotations

__all__: list[str] = []
