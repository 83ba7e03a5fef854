"""Everything that imports Rerun: the recording, what is drawn into it, and how its panels are arranged."""

from __future__ import annotations

import os

# Rerun's own variables must not matter: RERUN=off, common on build machines, leaves the recording empty; others abort
# the process, move the file or fill standard error.
for _name in [name for name in os.environ if name.lstrip("_").startswith("RERUN")]:
    del os.environ[_name]

from crkr.dashboard.rerun_view.display import RerunDisplay  # noqa: E402 - after the variables
from crkr.dashboard.rerun_view.recording import Recording  # noqa: E402 - after the variables

__all__ = ["Recording", "RerunDisplay"]
