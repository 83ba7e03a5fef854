"""The messages that docs/troubleshooting.md quotes are messages of the sources."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
ROOTS = ("protocol", "learner", "client", "server", "sim_worker", "dashboard", "experiments")
GAP = re.compile(r"\.\.\.|\b\d+\b|\b[NMXWC]\b|'t'|-wal|\bsuccess\b|[:;,]")
"""What stands for a value in a quoted message, or ends a part of it."""


def phrases(row: str) -> list[str]:
    """Parts of two words and more of the messages that the first cell of a row quotes."""
    quoted = re.findall(r"`([^`]+)`", row.split("|")[1])
    parts = [part.strip() for code in quoted for part in GAP.split(code)]
    return [part for part in parts if " " in part and not part.startswith("crkr ")]


def texts(source: str) -> Iterator[str]:
    """Every text of a module, with a gap where an f-string has a value."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "\0" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def stale(rows: list[str], known: str) -> list[str]:
    """Rows of whose quoted messages no part is known."""
    return [row for row in rows if phrases(row) and not any(part in known for part in phrases(row))]


def test_every_quoted_message_is_in_the_sources() -> None:
    rows = [row for row in (REPOSITORY / "docs/troubleshooting.md").read_text().splitlines() if row.startswith("| ")]
    modules = [path for root in ROOTS for path in (REPOSITORY / root).rglob("*.py")]
    known = "\n".join(text for path in modules for text in texts(path.read_text()))
    assert len([row for row in rows if phrases(row)]) > 30
    assert stale(rows, known) == []


def test_a_message_that_no_source_has_is_found() -> None:
    known = "\n".join(texts('raise Bad(f"row {n}: a quote is opened " "here")'))
    assert stale(["| `row N: a quote is opened here` | a | b |", "| `no such thing` | a | b |"], known) == [
        "| `no such thing` | a | b |"
    ]
