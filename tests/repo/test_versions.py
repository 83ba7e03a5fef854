"""One version: the project's, the changelog's, the command's."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
VERSION: str = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["version"]
HEADING = re.compile(r"^## \[(?P<version>[^\]]+)\](?: - (?P<date>\d{4}-\d{2}-\d{2}))?$", re.MULTILINE)


def test_the_changelog_begins_with_what_is_unreleased_and_then_this_version() -> None:
    headings = list(HEADING.finditer((REPOSITORY / "CHANGELOG.md").read_text()))
    assert [heading["version"] for heading in headings[:2]] == ["Unreleased", VERSION]
    assert all(heading["date"] for heading in headings[1:])


def test_the_changelog_lists_versions_newest_first() -> None:
    versions = [
        tuple(map(int, heading["version"].split(".")))
        for heading in HEADING.finditer((REPOSITORY / "CHANGELOG.md").read_text())
        if heading["version"] != "Unreleased"
    ]
    assert versions == sorted(set(versions), reverse=True)


def test_the_command_tells_the_version() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "crkr.client", "--version"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert VERSION in done.stdout.split()
