"""Reads recordings back without any viewer."""

import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from rerun.chunk import RrdReader

from crkr.dashboard.rerun_view import Recording

Tables = dict[str, list[Any]]  # entity -> its record batches


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "run.rrd"


@pytest.fixture
def recording(file: Path) -> Recording:
    """Writes to the file and serves nobody; the test closes it."""
    return Recording(None, file)


@pytest.fixture
def read() -> Callable[[Path], Tables]:
    """Reads a verified recording: what was logged by entity."""

    def tables(path: Path) -> Tables:
        verify(path)
        reader = RrdReader(str(path))
        (store,) = reader.recordings()
        assert store.application_id == "crkr"
        found: Tables = {}
        for chunk in reader.stream(store=store).to_chunks():
            found.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
        return found

    return tables


def verify(path: Path) -> None:
    """Asks Rerun's own tool whether a file is complete."""
    package = find_spec("rerun_cli")
    assert package is not None
    assert package.origin is not None
    tool = Path(package.origin).with_name("rerun")
    checked = subprocess.run([tool, "rrd", "verify", path], capture_output=True, text=True, timeout=30, check=False)
    assert checked.returncode == 0, checked.stderr
