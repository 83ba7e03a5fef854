"""The arm: kinematics, dynamics, limits and collisions."""

from __future__ import annotations

__all__: list[str] = []
