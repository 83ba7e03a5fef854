"""Live displays of a task: Rerun in the browser or natively, or tables in the terminal. Knows no skill."""

from __future__ import annotations

from crkr.dashboard.feed import Feed, View
from crkr.dashboard.progress import EpochResult, Progress, Row
from crkr.dashboard.telemetry import Telemetry

__all__ = ["EpochResult", "Feed", "Progress", "Row", "Telemetry", "View"]
