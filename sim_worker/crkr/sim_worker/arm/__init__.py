"""The six-joint arm that the shipped skills share: kinematics, dynamics, collisions, control."""

from __future__ import annotations

__all__: list[str] = []
