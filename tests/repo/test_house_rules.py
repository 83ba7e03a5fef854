"""Rules about the text of the sources that no linter has: places, sizes, promises, ignores."""

import re
import tomllib
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
ROOTS: list[str] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["dev-mode-dirs"]
FOLDERS = [*ROOTS, "tests", "examples", "docs", "scripts", "requirements", ".ci"]
TEXT = {
    "",
    ".cfg",
    ".css",
    ".html",
    ".in",
    ".js",
    ".json",
    ".lock",
    ".md",
    ".py",
    ".sh",
    ".toml",
    ".xml",
    ".yaml",
    ".yml",
}
LONGEST = 350
LONG_FOR_A_REASON = {"learner/crkr/learner/selection/priority_tree.py": "numba's cache looks at one file only"}

MACHINE = re.compile(r"(?<![\w.$}])/(?:work|root|opt/wheels|opt/pypi|home/\w+|tmp)\b")
REGISTRY = re.compile(r"pypi\.org|pythonhosted|artifactory|nexus|devpi|index-url|find-links", re.IGNORECASE)
EVERYWHERE = re.compile(r"0\.0\.0\.0|\[::\]")
PROMISE = re.compile(r"\b(?:TODO|FIXME|XXX|HACK)\b")
BARE_IGNORE = re.compile(
    r"# noqa(?!: [A-Z]+\d+(?:, ?[A-Z]+\d+)*\s+(?:[-#]|because)\s*\w)"
    r"|# type: ignore(?!\[[\w, -]+\]\s+(?:[-#]|because)\s*\w)"
)
ASLEEP = re.compile(r"\btime\.sleep\(|\bpytest\.(?:mark\.)?(?:skip|skipif|xfail|importorskip)\b|\bunittest\.mock\b")


def files() -> list[Path]:
    """Every text file of the project; what a run or a tool left beside them is not looked at."""
    inner = [path for folder in FOLDERS for path in (REPOSITORY / folder).rglob("*") if path.is_file()]
    top = [path for path in REPOSITORY.iterdir() if path.is_file() and path.name != ".git"]  # a second work tree's
    return sorted(
        path
        for path in [*inner, *top]
        if path.suffix in TEXT and "__pycache__" not in path.parts and path != Path(__file__)
    )


def found(pattern: re.Pattern[str], paths: list[Path]) -> list[str]:
    """Where a pattern occurs, as `file:line: text`."""
    return [
        f"{path.relative_to(REPOSITORY)}:{number}: {line.strip()}"
        for path in paths
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(line)
    ]


def python() -> list[Path]:
    return [path for path in files() if path.suffix == ".py"]


def test_the_search_sees_the_project() -> None:
    names = {path.relative_to(REPOSITORY).as_posix() for path in files()}
    assert {"pyproject.toml", "Makefile", "tests/conftest.py", "requirements/dev.lock"} <= names
    assert all(any(name.startswith(f"{root}/crkr/{root}/") for name in names) for root in ROOTS)


def test_no_file_names_a_place_on_one_machine() -> None:
    assert found(MACHINE, files()) == []


def test_no_file_names_a_registry() -> None:
    allowed = {REPOSITORY / "scripts" / "lock", REPOSITORY / "tests" / "repo" / "test_locks.py"}  # they forbid it
    assert found(REGISTRY, [path for path in files() if path not in allowed]) == []


def test_nothing_listens_on_every_interface_unless_a_container_does() -> None:
    assert found(EVERYWHERE, python()) == []
    assert len(found(EVERYWHERE, [REPOSITORY / "compose.yaml"])) > 0


def test_no_file_promises_to_be_finished_later() -> None:
    assert found(PROMISE, files()) == []


def test_every_ignore_names_its_rule_and_gives_its_reason() -> None:
    assert found(BARE_IGNORE, python()) == []


def test_no_test_sleeps_skips_or_mocks() -> None:
    # A user may have no browser and no Python 3.10; CI has both. Nobody needs the extra `rivals`.
    names = ("shared/browser.py", "compatibility/test_python310.py", "experiments/rivals/test_rivals.py")
    lacking = {REPOSITORY / "tests" / name for name in names}
    tests = [path for path in python() if path.is_relative_to(REPOSITORY / "tests") and path not in lacking]
    assert found(ASLEEP, tests) == []


def test_no_module_is_longer_than_a_reader_can_hold() -> None:
    lengths = {path.relative_to(REPOSITORY).as_posix(): len(path.read_text().splitlines()) for path in python()}
    assert {name for name, length in lengths.items() if length > LONGEST} == set(LONG_FOR_A_REASON)


@pytest.mark.parametrize(
    ("pattern", "bad", "good"),
    [
        (MACHINE, 'DATA = "/home/ada/data"', "crkr/@v1/task/home/tmp"),
        (MACHINE, "open('/tmp/x')", "tmp_path / 'x'"),
        (REGISTRY, "https://pypi.org/simple", "the package registry"),
        (EVERYWHERE, 'listen = "tcp/0.0.0.0:7447"', 'listen = "tcp/127.0.0.1:7447"'),
        (PROMISE, "# TODO: later", "todo_list"),
        (BARE_IGNORE, "x = y  # noqa", "x = y  # noqa: E501 - a table is read in rows"),
        (BARE_IGNORE, "x = y  # type: ignore", "x = y  # type: ignore[attr-defined]  # built in C"),
        (BARE_IGNORE, "x = y  # noqa: E501", "x = y  # noqa: E501, F401  # a table is read in rows"),
        (ASLEEP, "time.sleep(1)", "process.wait(timeout=1)"),
        (ASLEEP, "@pytest.mark.skip", "@pytest.mark.parametrize"),
    ],
)
def test_each_search_finds_the_bad_and_lets_the_good_pass(pattern: re.Pattern[str], bad: str, good: str) -> None:
    assert pattern.search(bad)
    assert not pattern.search(good)
