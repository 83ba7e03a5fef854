"""What the documents point at exists."""

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
DOCUMENTS = sorted(
    [*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md"), *(REPOSITORY / "examples").rglob("*.md")]
)
LINK = re.compile(r"\]\((?!https?://|#)([^)#\s]+)")
TARGET = re.compile(r"\bmake ([a-z][a-z-]*)")
FENCED = re.compile(r"^```.*?^```|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def broken_links(text: str, folder: Path) -> list[str]:
    return [target for target in LINK.findall(text) if not (folder / target).exists()]


def unknown_targets(text: str, makefile: str) -> set[str]:
    """Names that a document says to `make` and that the Makefile does not know."""
    known = set(re.findall(r"^([a-z][a-z-]*):", makefile, re.MULTILINE))
    return {name for code in FENCED.findall(text) for name in TARGET.findall(code)} - known


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_of_a_document_leads_somewhere(document: Path) -> None:
    assert broken_links(document.read_text(), document.parent) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_target_that_a_document_names_is_in_the_makefile(document: Path) -> None:
    assert unknown_targets(document.read_text(), (REPOSITORY / "Makefile").read_text()) == set()


def test_a_broken_link_and_an_unknown_target_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.md").touch()
    assert broken_links("[a](a.md) [b](b.md) [c](https://example.org/c) [d](a.md#part)", tmp_path) == ["b.md"]
    assert unknown_targets("to make sense, run `make test` or `make tea`", "test: lint\n") == {"tea"}
