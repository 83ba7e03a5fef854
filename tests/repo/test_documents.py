"""What the documents point at exists."""

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
DOCUMENTS = sorted(
    [*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md"), *(REPOSITORY / "examples").rglob("*.md")]
)
LINK = re.compile(r"\]\((?!https?://|#)([^)\s]+)")
TARGET = re.compile(r"\bmake ([a-z][a-z-]*)")
CODE = re.compile(r"`([^`\n]+)`")
MODULE = re.compile(r"(?P<path>[\w./-]+\.py)(?:::(?P<name>\w+))?")
FOLDER = re.compile(
    r"(?:tests|examples|docs|protocol|learner|client|server|sim_worker|dashboard|experiments)(?:/[\w.-]+)+"
)
ROW = re.compile(r"^\|[^|]+\| `(?P<path>[\w./]+)` \| `(?P<name>[\w.]+)`", re.MULTILINE)
PART = re.compile(r"^\| (?:\*\*)?`(?P<folder>[\w/]+)`(?:\*\*)? \|[^|]+\|(?P<modules>[ `\w]*)\|$", re.MULTILINE)
FENCED = re.compile(r"^```.*?^```|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def broken_links(text: str, folder: Path) -> list[str]:
    return [target for target in LINK.findall(text) if not _exists(folder, *target.partition("#")[::2])]


def _exists(folder: Path, name: str, heading: str) -> bool:
    path = folder / name
    return path.exists() and (not heading or heading in headings(path.read_text()))


def headings(text: str) -> set[str]:
    """Names by which headings can be linked to: in lower case, without punctuation, with a dash for each space."""
    lines = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", line.lower()).replace(" ", "-") for line in lines}


def unknown_targets(text: str, makefile: str) -> set[str]:
    """Names that a document says to `make` and that the Makefile does not know."""
    known = set(re.findall(r"^([a-z][a-z-]*):", makefile, re.MULTILINE))
    return {name for code in FENCED.findall(text) for name in TARGET.findall(code)} - known


def missing_paths(text: str, repository: Path) -> list[str]:
    """Modules, tests and folders of the repository that a document names in backticks and that do not exist."""
    missing = []
    for code in CODE.findall(text):
        if match := MODULE.fullmatch(code):
            inner = match["path"].removeprefix("./")
            found = [repository / inner] if "/" in inner else sorted(repository.glob(f"[!.]*/**/{inner}"))
            sources = [path.read_text() for path in found if path.is_file()]
            if not any(match["name"] is None or f"def {match['name']}(" in source for source in sources):
                missing.append(code)
        elif FOLDER.fullmatch(code) and not (repository / code).exists():
            missing.append(code)
    return missing


def wrong_rows(text: str, repository: Path) -> list[str]:
    """Rows of a table "question, path, name" whose module does not define the name, a function or `Class.method`."""
    wrong = []
    for row in ROW.finditer(text):
        path = repository / row["path"]
        source = path.read_text() if path.is_file() else ""
        if not all(
            re.search(rf"^ *(?:async )?(?:def|class) {part}\b", source, re.M) for part in row["name"].split(".")
        ):
            wrong.append(f"{row['path']}: {row['name']}")
    return wrong


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_module_and_test_that_a_document_names_exists(document: Path) -> None:
    if document.name != "CHANGELOG.md":  # it is history
        assert missing_paths(document.read_text(), REPOSITORY) == []


def test_the_table_of_places_is_true() -> None:
    text = (REPOSITORY / "ARCHITECTURE.md").read_text()
    assert len(ROW.findall(text)) >= 15
    assert wrong_rows(text, REPOSITORY) == []


def test_the_table_of_parts_names_every_module() -> None:
    listed: dict[str, list[str]] = {}
    root = ""
    for folder, modules in PART.findall((REPOSITORY / "ARCHITECTURE.md").read_text()):
        root = folder.rstrip("/") if folder.endswith("/") else root
        listed[root if folder.endswith("/") else f"{root}/{folder}"] = CODE.findall(modules)
    held: dict[str, list[str]] = {}
    for path in sorted(REPOSITORY.glob("*/crkr/*/**/*.py")):
        if not path.stem.startswith("__"):
            parts = path.parent.relative_to(REPOSITORY).parts
            held.setdefault("/".join((parts[0], *parts[3:])), []).append(path.stem)
    assert len(held) > 30
    assert {folder: modules for folder, modules in listed.items() if modules} == held


def test_a_wrong_path_and_a_wrong_name_are_found() -> None:
    here = "tests/repo/test_documents.py"
    assert missing_paths(f"`{here}` `{here}::test_the_table_of_places_is_true` `tests/repo`", REPOSITORY) == []
    assert missing_paths(f"`tests/no.py` `{here}::test_no` `nowhere.py` `tests/no`", REPOSITORY) == [
        *("tests/no.py", f"{here}::test_no", "nowhere.py", "tests/no"),
    ]
    assert wrong_rows(f"| a | `{here}` | `wrong_rows` |\n| b | `{here}` | `Wrong.rows` |", REPOSITORY) == [
        f"{here}: Wrong.rows"
    ]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_of_a_document_leads_somewhere(document: Path) -> None:
    assert broken_links(document.read_text(), document.parent) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_target_that_a_document_names_is_in_the_makefile(document: Path) -> None:
    assert unknown_targets(document.read_text(), (REPOSITORY / "Makefile").read_text()) == set()


def test_a_broken_link_and_an_unknown_target_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("## The robot's part\n")
    text = "[a](a.md) [b](b.md) [c](https://example.org/c) [d](a.md#the-robots-part) [e](a.md#whole)"
    assert broken_links(text, tmp_path) == ["b.md", "a.md#whole"]
    assert unknown_targets("to make sense, run `make test` or `make tea`", "test: lint\n") == {"tea"}
