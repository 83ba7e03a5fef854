"""A local copy of a task's policy; needs the extra 'mirror'."""

from __future__ import annotations

__all__ = ["Mirror"]

from crkr.client.mirror.mirror import Mirror
