"""The compiled selection, once it is loaded.

It needs numba, the extra `fast`. Loading takes about a second, and compiling some ten seconds, once per machine and
version; so a program must ask for it. Without it the selection is the same, but slow for many samples.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from crkr.learner.selection.selector import Radii

if TYPE_CHECKING:
    from crkr.learner.selection.tree_radii import TreeRadii

__all__ = ["accelerable", "accelerate", "tree_radii"]

_loaded: list[type[TreeRadii]] = []  # at most one; a module is loaded once


def accelerable() -> bool:
    """Whether numba is installed."""
    try:
        return find_spec("numba") is not None
    except ModuleNotFoundError:
        return False


def accelerate() -> bool:
    """Load the compiled selection for all learners of this process; False without numba.

    Compiles it first if needed, into the user's cache (NUMBA_CACHE_DIR, if set). Any thread may call it.
    """
    if not accelerable():
        return False
    if not _loaded:
        from crkr.learner.selection.tree_radii import TreeRadii

        radii, Z, costs = TreeRadii(1), np.array([[0.0], [1.0], [2.0]]), np.array([0.1, 0.2, 0.3])
        radii.extend(Z, costs)  # calls every function once, which compiles or loads it
        radii.recost(np.array([0]), np.array([0.4]))
        radii.remove(np.array([1]))
        radii.rebuild(Z, costs, None)
        radii.rebuild(Z, costs, Radii(radii.r2.copy(), radii.suppressors))
        _loaded.append(TreeRadii)
    return True


def tree_radii() -> type[TreeRadii] | None:
    """The compiled form, if it was loaded."""
    return _loaded[0] if _loaded else None
