"""The paper's figures, the comparison study and the bench of the learner."""

from __future__ import annotations

__all__: list[str] = []
