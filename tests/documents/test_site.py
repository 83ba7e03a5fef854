"""The documents as a site: built without a warning, and with what is generated."""

import os
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False, cwd=REPOSITORY, env=quiet)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


def test_every_page_is_built(site: Path) -> None:
    pages = [path.relative_to(REPOSITORY / "docs") for path in (REPOSITORY / "docs").rglob("*.md")]
    assert len(pages) >= 20
    assert [page for page in pages if not (site / page.with_suffix(".html")).is_file()] == []


def test_the_reference_has_all_commands_and_settings(site: Path) -> None:
    commands = (site / "reference" / "commands.html").read_text()
    names = [name.replace(".", "-") for name in entry_points(group="crkr.commands").names]
    assert [name for name in names if f'id="crkr-{name}"' not in commands] == []
    specification = (site / "reference" / "specification.html").read_text()
    assert all(word in specification for word in ("exploration_floor", "StateDimension", "temperature"))
    python = (site / "reference" / "python.html").read_text()
    assert all(word in python for word in ("create_task", "client.task.Task.report", "gymnasium_skill", "NovelState"))


def test_links_out_of_the_documents_lead_to_the_files(site: Path) -> None:
    assert "files/examples/gymnasium_reacher.py.html" in (site / "gymnasium.html").read_text()
    assert "gymnasium_skill" in (site / "files" / "examples" / "gymnasium_reacher.py.html").read_text()


def test_nothing_is_fetched_from_elsewhere_while_reading(site: Path) -> None:
    page = (site / "tutorial.html").read_text()
    assert 'src="http' not in page
    assert "fonts.g" not in page
