"""Everything that imports Rerun: the recording, what is drawn into it, and how its panels are arranged."""

from __future__ import annotations

from crkr.dashboard.rerun_view.display import RerunDisplay
from crkr.dashboard.rerun_view.recording import Recording

__all__ = ["Recording", "RerunDisplay"]
