"""The policy service. It is a process, not a library: `crkr server` runs it, and `crkr.server.server` holds it."""

from __future__ import annotations

__all__: list[str] = []  # importing the package stays light, so that `crkr --help` does
