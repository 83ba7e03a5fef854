"""Features of Python 3.11 and numpy 2 for the client on Python 3.10 and numpy 1.26, which ROS 2 ships."""

from __future__ import annotations

import sys
from datetime import timezone

import numpy as np

from crkr.protocol.codec import Array

if sys.version_info >= (3, 11):
    from typing import NotRequired, Self, Unpack
else:
    from typing_extensions import NotRequired, Self, Unpack

__all__ = ["UTC", "NotRequired", "Self", "Unpack", "vecdot"]

UTC = timezone.utc


def _products(a: Array, b: Array) -> Array:
    """Scalar products of vectors (..., n)."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


vecdot = np.vecdot if hasattr(np, "vecdot") else _products
