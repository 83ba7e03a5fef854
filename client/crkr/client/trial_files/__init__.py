"""Trials in files for other programs: Parquet, CSV and NumPy's npz, with the same columns."""

from __future__ import annotations

__all__ = [
    "FileRow",
    "Layout",
    "Sink",
    "Source",
    "WarmStartReport",
    "check_kind",
    "trial_sink",
    "trial_source",
    "warm_start",
]

from crkr.client.trial_files.files import Sink, Source, check_kind, trial_sink, trial_source
from crkr.client.trial_files.layout import FileRow, Layout
from crkr.client.trial_files.warm_start import WarmStartReport, warm_start
