"""All of crkr on one machine: server, workers and dashboard as real processes, followed through the log."""

from __future__ import annotations

from crkr.sim_worker.demo.run_history import EpochScore, RunHistory

__all__ = ["EpochScore", "RunHistory"]
