"""Figures are files, whatever the environment says of windows, styles and places."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from crkr.protocol import Invalid
from crkr.sim_worker.figure import check_figure

DRAWS = """
import sys
from pathlib import Path
from crkr.sim_worker.figure import new_figure, save_figure
figure = new_figure(2, 1)
figure.add_subplot().plot([1, 2])
save_figure(figure, Path(sys.argv[1]))
"""


@pytest.mark.parametrize(
    "environment",
    [
        {"MPLBACKEND": "module://matplotlib_inline.backend_inline"},
        {"MPLBACKEND": "QtAgg"},
        {"MPLBACKEND": "none-of-matplotlib's"},
        {"SOURCE_DATE_EPOCH": "yesterday"},
        {"HOME": "/nowhere", "MPLCONFIGDIR": "/proc/nowhere", "DISPLAY": ":77"},
        {"LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONWARNINGS": "error"},
    ],
    ids=lambda environment: next(iter(environment.values())),
)
def test_a_figure_is_drawn(tmp_path: Path, environment: dict[str, str]) -> None:
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nbackend: TkAgg\n")
    command = [sys.executable, "-c", DRAWS, "figure.png"]
    done = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_a_figure_of_no_known_kind_is_refused_before_the_work(tmp_path: Path) -> None:
    check_figure(tmp_path / "a.SVG", overwrite=False)
    for name in ("figure", "figure.xyz"):
        with pytest.raises(Invalid, match=r"ends in \.png"):
            check_figure(tmp_path / name, overwrite=False)
