"""Specification files: TOML or JSON to read, JSON to write."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final

from crkr.client.cli.error_lines import reason_missing
from crkr.client.cli.output_file import check_input
from crkr.protocol import Invalid, StorageError, TaskSpec, Unsupported

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["STANDARD_OUTPUT", "read_spec", "skill_spec", "write_spec"]

GROUP: Final = "crkr.specifications"
"""Entry points that make a skill's specification; `skill` is called with the skill's name and options."""

STANDARD_OUTPUT: Final = Path("-")
_LARGEST: Final = 2**19  # bytes of a file; a specification with 256 coordinates everywhere has a fifth of it
_MOST_DOTS: Final = 128  # of a key, for which the reader takes time by the square; prose has no more in a line
_LONGEST_MESSAGE: Final = 1000  # characters; it may list thousands of fields
_NO_KEY: Final = re.compile(r"[=,\[\]{}#]")


def read_spec(path: Path) -> TaskSpec:
    """Reads a file; one named .json is JSON, any other TOML.

    Raises:
        Invalid: It is neither, or no specification.
        StorageError: It cannot be read.
    """
    is_json = path.suffix == ".json"
    check_input(path)
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST + 1)
    except OSError as error:
        raise StorageError(f"{path} cannot be read: {error.strerror}") from error
    if len(data) > _LARGEST:
        raise Invalid(f"{path} has more than {_LARGEST} bytes, which no specification has")
    try:
        text = data.decode("utf-8-sig")  # both formats are UTF-8 by definition, in any locale
        if not is_json and _has_endless_key(text):
            raise Invalid(f"a key has more than {_MOST_DOTS} parts")
        return TaskSpec.from_dict(json.loads(text) if is_json else tomllib.loads(text), strict=True)
    except Invalid as error:
        raise Invalid(f"{path}: {error.message[:_LONGEST_MESSAGE]}", details=error.details) from error
    except RecursionError as error:
        raise Invalid(f"{path} is nested too deep for a specification") from error
    except ValueError as error:  # includes numbers with thousands of digits
        raise Invalid(f"{path} is not {'JSON' if is_json else 'TOML'}: {error}") from error


def _has_endless_key(toml: str) -> bool:
    for line in toml.splitlines():
        parts = 0
        for part in line.split("."):
            parts = 0 if _NO_KEY.search(part) else parts + 1
            if parts > _MOST_DOTS:
                return True
    return False


def skill_spec(skill: str, /, **options: Any) -> TaskSpec:
    """Makes a skill's specification.

    Args:
        skill: An installed skill's name, or "package.module:factory".
        options: Its options: environment, launcher, preset, name, seed.

    Raises:
        Invalid: No such skill, or an unknown option.
        Unsupported: A library that the skill needs is not installed.
    """
    found = list(entry_points(group=GROUP, name="skill"))
    if not found:
        raise Unsupported("this installation knows no skills: pip install 'crkr[sim]'")
    try:
        spec: TaskSpec = found[0].load()(skill, **options)
    except ModuleNotFoundError as error:
        raise Unsupported(reason_missing(error, "create --skill", found[0].module)) from error
    return spec


def write_spec(spec: TaskSpec, path: Path) -> None:
    """Writes a specification with all defaults, one axis a line; "-" is standard output.

    Raises:
        Invalid: The file exists, or is not named .json.
    """
    text = "{\n" + ",\n".join(_fields(spec)) + "\n}\n"
    if path == STANDARD_OUTPUT:
        sys.stdout.write(text.replace("\x7f", "\\u007f"))  # JSON lets DEL stand
        return
    if path.suffix != ".json":
        raise Invalid(f"a specification is written as JSON; name the file .json, not {path.name}")
    try:
        file = path.open("x", encoding="utf-8")
    except FileExistsError as error:
        raise Invalid(f"{path} is there already, perhaps edited; choose another name, or remove it") from error
    try:
        with file:
            file.write(text)
    except OSError:
        path.unlink()  # half of it
        raise


def _fields(spec: TaskSpec) -> Iterator[str]:
    for name, value in spec.to_dict().items():
        if isinstance(value, list) and value:
            axes = ",\n".join(f"    {json.dumps(axis)}" for axis in value)
            yield f'  "{name}": [\n{axes}\n  ]'
        else:
            yield f'  "{name}": {json.dumps(value)}'
