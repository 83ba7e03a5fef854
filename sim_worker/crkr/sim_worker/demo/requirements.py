"""What a demo needs installed, looked for before anything is started."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Final

from crkr.protocol import Unsupported

__all__ = ["check_equipment"]

# A package of each extra that no other extra brings along, or the least of them.
SIGNS: Final = {"server": "scipy", "sim": "mujoco", "dashboard": "rerun"}


def check_equipment(dashboard: bool) -> None:
    """Raises `Unsupported` that names every extra a demo lacks, with or without its dashboard."""
    needed = [extra for extra in SIGNS if dashboard or extra != "dashboard"]
    missing = [extra for extra in needed if find_spec(SIGNS[extra]) is None]
    if missing == ["dashboard"]:
        return  # the demo goes on without it, and says so
    if missing:
        extras = ",".join(missing)
        raise Unsupported(f"crkr demo lacks the extras {', '.join(missing)}: pip install 'crkr[{extras}]'")
