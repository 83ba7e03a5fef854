"""Sentences begin with their subject."""

import io
import re
import tokenize
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
WHO = re.compile(r"\bWho(?:ever)?\b(?!\?)")
WORN = re.compile(
    r"\b(?:as it were|takes? note (?:of|that)|so many|has it done|none of (?:its|their) business"
    r"|for ever|for want of|anew|as ever|at hand|in hand|dearer|of no use|of one's own|work(?:s|ed) out"
    r"|t(?:ell|ells|old) of|(?:did|does) what (?:was|is) wanted)\b"
)
HEADLESS = re.compile(r"\b(?:That|Those) of (?:a|an|its|some|the|these|this)\b|\b(?:Is|Are|Was) told\b|\bThe same as\b")
"""Sentences whose subject the reader has to guess."""
PAGES = ["*.md", "docs/*.md", "examples/**/*", "Makefile", "scripts/*", "pyproject.toml", "compose.yaml", "Dockerfile"]


def prose(source: str) -> list[tuple[int, str]]:
    """Lines of a module's comments and strings, with their numbers."""
    words = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    return [
        (token.start[0] + number, line)
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type in words
        for number, line in enumerate(token.string.splitlines())
    ]


def complaints(pattern: re.Pattern[str], name: str, text: str) -> list[str]:
    lines = prose(text) if name.endswith(".py") else list(enumerate(text.splitlines(), 1))
    return [f"{name}:{number}: {line.strip()}" for number, line in lines if pattern.search(line)]


def pages() -> list[Path]:
    found = {path for glob in PAGES for path in REPOSITORY.glob(glob) if path.is_file()}
    return sorted(path for path in found if "__pycache__" not in path.parts)


def modules() -> list[Path]:
    return sorted(
        path
        for folder in ("protocol", "learner", "client", "server", "sim_worker", "dashboard", "experiments", "tests")
        for path in (REPOSITORY / folder).rglob("*.py")
        if path != Path(__file__)
    )


@pytest.mark.parametrize("pattern", [WHO, WORN, HEADLESS], ids=["who", "worn", "headless"])
@pytest.mark.parametrize("page", pages(), ids=lambda path: path.name)
def test_no_sentence_of_a_page_reads_so(page: Path, pattern: re.Pattern[str]) -> None:
    assert complaints(pattern, page.name, page.read_text()) == []


@pytest.mark.parametrize("pattern", [WHO, WORN, HEADLESS], ids=["who", "worn", "headless"])
def test_no_docstring_comment_or_text_of_a_module_reads_so(pattern: re.Pattern[str]) -> None:
    found = [
        line
        for path in modules()
        for line in complaints(pattern, path.relative_to(REPOSITORY).as_posix(), path.read_text())
    ]
    assert found == []


def test_the_search_finds_the_bad_and_lets_the_good_pass() -> None:
    source = '"""Who asks waits."""\nWhoever = 1\nx = 1  # Whoever comes\ny = f"{x} Who asks"\nz = "who asks"\n'
    assert [line.split(":")[1] for line in complaints(WHO, "a.py", source)] == ["1", "3", "4"]
    assert complaints(WHO, "a.md", "A client that asks waits.\nWho?\n") == []
    assert complaints(HEADLESS, "a.md", "Those of a task.\nThe scales of a task.\n") == ["a.md:1: Those of a task."]
    assert complaints(WORN, "a.md", "It is built anew.\nIt is rebuilt.\n") == ["a.md:1: It is built anew."]
