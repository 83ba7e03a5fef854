"""Code is written once: no two source files share six lines, but for a reason."""

import ast
import tomllib
from collections import defaultdict
from itertools import combinations
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
ROOTS: list[str] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["dev-mode-dirs"]
LINES = 6
CLONES = {
    ("mirror.py", "task.py"): "a signature that users see in both places",
    ("processes.py", "lease.py"): "a thread within a block, in two parts that may not import each other",
    ("launchers.py", "layouts.py"): "the fields of a distribution, which two skills draw from in their own way",
}


def code(source: str) -> list[str]:
    """Lines without blank ones, comments, imports, strings of their own and lone punctuation."""
    skipped: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant()) | ast.Import() | ast.ImportFrom():
                skipped |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines = [line.strip() for number, line in enumerate(source.splitlines(), 1) if number not in skipped]
    return [line for line in lines if any(map(str.isalpha, line)) and not line.startswith("#")]


def clones(sources: dict[str, str]) -> set[tuple[str, str]]:
    """Pairs of files that share a run of lines."""
    places = defaultdict[tuple[str, ...], set[str]](set)
    for name, source in sources.items():
        lines = code(source)
        for first in range(len(lines) - LINES + 1):
            places[tuple(lines[first : first + LINES])].add(name)
    return {pair for names in places.values() for pair in combinations(sorted(names), 2)}


def test_no_two_source_files_share_six_lines_of_code() -> None:
    paths = [path for root in ROOTS for path in (REPOSITORY / root / "crkr").rglob("*.py")]
    assert len(paths) > 300
    found = clones({path.relative_to(REPOSITORY).as_posix(): path.read_text() for path in paths})
    assert {(Path(one).name, Path(other).name) for one, other in found} == set(CLONES), found


def test_a_clone_is_found_and_what_repeats_by_itself_is_not() -> None:
    lines = "\n".join(f"x{number} = {number}" for number in range(LINES))
    words = '"""' + "\n".join(f"word {number}" for number in range(LINES)) + '"""\n' + "import os\n" * LINES
    assert clones({"a": lines, "b": f"y = 1\n\n{lines}\n", "c": lines[:-6]}) == {("a", "b")}
    assert clones({"a": words, "b": words}) == set()
