"""What a demo tells its user to type."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from crkr.sim_worker.demo.summary import script


def test_a_script_outside_path_is_named_by_its_own_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    said = script("crkr")
    assert os.sep in said
    assert subprocess.run([said, "--version"], check=True, capture_output=True, timeout=60).stdout


def test_a_script_on_path_is_named_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    assert script("crkr") == "crkr"
