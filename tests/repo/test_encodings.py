"""Text files and pipes name their encoding: the locale's is another on another machine."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
FOLDERS = [*PYPROJECT["tool"]["hatch"]["build"]["dev-mode-dirs"], "examples", "scripts"]
OPENERS = {"open": 1, "fdopen": 1, "NamedTemporaryFile": 0, "TemporaryFile": 0}  # and where their mode stands
ALWAYS_TEXT = {"read_text", "write_text", "TextIOWrapper", "FileHandler"}
NO_FILES = {"os", "zenoh", "av", "archive", "session", "self", "Image", "wave"}  # what else has a method `open`


def unnamed(source: str) -> list[int]:
    """Lines of calls that take the locale's encoding."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    return [call.lineno for call in calls if _is_text(call) and "encoding" not in _words(call)]


def _words(call: ast.Call) -> dict[str | None, ast.expr]:
    return {word.arg: word.value for word in call.keywords}


def _is_text(call: ast.Call) -> bool:
    words = _words(call)
    if any(isinstance(words.get(name), ast.Constant) for name in ("text", "universal_newlines")):
        return True
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if name in ALWAYS_TEXT:
        return True
    if name not in OPENERS:
        return False
    place = OPENERS[name]
    if isinstance(call.func, ast.Attribute) and name == "open":
        if isinstance(call.func.value, ast.Name | ast.Attribute) and _last(call.func.value) in NO_FILES:
            return False
        place = 0  # a path's own
    mode = words.get("mode", call.args[place] if len(call.args) > place else None)
    if mode is None:
        return name not in ("NamedTemporaryFile", "TemporaryFile")
    return not isinstance(mode, ast.Constant) or (isinstance(mode.value, str) and "b" not in mode.value)


def _last(name: ast.expr) -> str:
    return name.attr if isinstance(name, ast.Attribute) else getattr(name, "id", "")


def sources() -> Iterator[Path]:
    for folder in FOLDERS:
        for path in sorted((REPOSITORY / folder).rglob("*")):
            if path.is_file() and (path.suffix == ".py" or path.read_bytes()[:40].startswith(b"#!/usr/bin/env python")):
                yield path


def test_every_text_file_and_pipe_of_the_sources_names_its_encoding() -> None:
    found = list(sources())
    assert len(found) > 100
    assert [
        f"{path.relative_to(REPOSITORY)}:{line}" for path in found for line in unnamed(path.read_text(encoding="utf-8"))
    ] == []


@pytest.mark.parametrize(
    "source",
    [
        "path.read_text()",
        "path.write_text(x)",
        "path.open()",
        "path.open('w')",
        "open(path)",
        "open(path, mode)",
        "os.fdopen(file, 'w')",
        "subprocess.run(words, text=True)",
        "NamedTemporaryFile('w')",
    ],
)
def test_the_search_finds_what_it_is_for(source: str) -> None:
    assert unnamed(source) == [1]
    assert unnamed(f"{source[:-1]}{'' if source.endswith('()') else ', '}encoding='utf-8')") == []


@pytest.mark.parametrize(
    "source", ["open(path, 'rb')", "path.open('wb')", "zenoh.open(config)", "NamedTemporaryFile()"]
)
def test_bytes_have_no_encoding(source: str) -> None:
    assert unnamed(source) == []
