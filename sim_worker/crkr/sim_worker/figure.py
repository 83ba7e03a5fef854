"""Figures that are only ever saved to files, drawn alike whatever the environment says of windows and styles."""

from __future__ import annotations

import os
from pathlib import Path

# A notebook's kernel names a backend that lives in the notebook's environment. Matplotlib, which looks at this variable
# while it is imported, refuses to load where that backend is not installed.
os.environ["MPLBACKEND"] = "agg"
if not os.environ.get("SOURCE_DATE_EPOCH", "0").isdecimal():  # a build's clock, which fonts are read by
    del os.environ["SOURCE_DATE_EPOCH"]

import matplotlib as mpl
from matplotlib.figure import Figure

from crkr.client.cli.output_file import check_output, output_file
from crkr.protocol import Invalid

__all__ = ["check_figure", "mpl", "new_figure", "save_figure"]

mpl.rcdefaults()  # a matplotlibrc in the working directory may ask for what is not installed, such as LaTeX


def check_figure(path: Path, *, overwrite: bool) -> None:
    """Raises `Invalid` before the work where no figure can or may be saved at `path`; as `check_output`."""
    kinds = sorted(Figure().canvas.get_supported_filetypes())
    if path.suffix[1:].lower() not in kinds:
        raise Invalid(f"a figure's name ends in .png, .svg or .pdf; got {path.name}")
    check_output(path, overwrite=overwrite)


def new_figure(width: float, height: float, dpi: int = 120) -> Figure:
    """An empty figure; width and height in inches."""
    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def save_figure(figure: Figure, path: Path) -> None:
    """Saves a figure as the suffix of `path` says; a file that is there is replaced by the whole new one."""
    with output_file(path) as partial:
        figure.savefig(partial)
