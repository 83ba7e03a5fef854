"""`crkr bench`: measurements beside a bare baseline, in one run."""

from __future__ import annotations

__all__: list[str] = []
