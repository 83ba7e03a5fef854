"""Where workers and runs are executed: on this machine, or on the nodes of a cluster."""

from __future__ import annotations

__all__: list[str] = []
