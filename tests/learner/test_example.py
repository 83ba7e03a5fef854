from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "crkr_1d.py"


def test_the_example_draws_its_figure_in_under_thirty_lines(tmp_path: Path) -> None:
    picture = tmp_path / "policy.png"
    environment = {**os.environ, "MPLBACKEND": "Agg", "MPLCONFIGDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), str(picture)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"picture: {picture}\n"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert len(EXAMPLE.read_text().splitlines()) < 30
