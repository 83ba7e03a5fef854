"""Matplotlib figures for files, independent of the environment's backend and style."""

from __future__ import annotations

import os
from pathlib import Path

# A notebook's kernel names a backend that only the notebook's environment has. Matplotlib reads the variable during its
# import, which fails where that backend is missing.
os.environ["MPLBACKEND"] = "agg"
if not os.environ.get("SOURCE_DATE_EPOCH", "0").isdecimal():  # a build's clock, which fonts are read by
    del os.environ["SOURCE_DATE_EPOCH"]

import matplotlib as mpl
from matplotlib.figure import Figure

from crkr.client.cli.output_file import check_output, output_file
from crkr.protocol import Invalid

__all__ = ["check_figure", "mpl", "new_figure", "save_figure"]

mpl.rcdefaults()  # a matplotlibrc in the working directory may ask for LaTeX, which may be missing


def check_figure(path: Path, *, overwrite: bool) -> None:
    """Raises `Invalid`, before the work, if no figure can or may be saved at `path`."""
    kinds = sorted(Figure().canvas.get_supported_filetypes())
    if path.suffix[1:].lower() not in kinds:
        raise Invalid(f"a figure's name ends in .png, .svg or .pdf; got {path.name}")
    check_output(path, overwrite=overwrite)


def new_figure(width: float, height: float, dpi: int = 120) -> Figure:
    """An empty figure; width and height in inches."""
    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def save_figure(figure: Figure, path: Path) -> None:
    """Saves a figure in the format of the suffix of `path`; replaces an existing file at the end."""
    with output_file(path) as partial:
        figure.savefig(partial)
