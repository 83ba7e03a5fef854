"""`crkr bench`: the service beside a bare echo of the same bytes, in turns and in one run."""

from __future__ import annotations

__all__: list[str] = []
