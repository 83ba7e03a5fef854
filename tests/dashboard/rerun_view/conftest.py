"""Reads recordings back without any viewer."""

import re
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
        rerun("verify", path)
        reader = RrdReader(str(path))
        (store,) = reader.recordings()
        assert store.application_id == "crkr"
        found: Tables = {}
        for chunk in reader.stream(store=store).to_chunks():
            found.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
        return found

    return tables


@pytest.fixture
def in_order() -> Callable[[Path], list[str]]:
    """The entities of a file's chunks, the run's and the layout's, and "BlueprintActivationCommand", as they come."""
    line = re.compile(r"^(?:Chunk\(.*\) with \d+ rows \(.*?\) - (?P<entity>\S+) - |(?P<command>Blueprint\w*)\()", re.M)

    def entities(path: Path) -> list[str]:
        return [found["entity"] or found["command"] for found in line.finditer(rerun("print", path))]

    return entities


def rerun(command: str, path: Path) -> str:
    """What Rerun's own tool prints about a file that it finds nothing wrong with."""
    package = find_spec("rerun_cli")
    assert package is not None
    assert package.origin is not None
    tool = Path(package.origin).with_name("rerun")
    done = subprocess.run([tool, "rrd", command, path], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
