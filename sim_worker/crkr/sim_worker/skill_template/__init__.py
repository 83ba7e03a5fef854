"""The template of a skill, and the function by which `crkr new` copies it."""

from __future__ import annotations

import re
import sys
from importlib.resources import files
from importlib.util import find_spec
from keyword import iskeyword
from pathlib import Path

from crkr.protocol import Invalid

__all__ = ["task_name", "write_skill"]

_FILES = ("my_robot.py", "my_robot.toml", "test_my_robot.py.txt")  # the last is not a test of this package


def task_name(module: str) -> str:
    """Name of the task of a skill in that module, as my-robot."""
    return "-".join(word for word in module.split("_") if word)


def write_skill(name: str, folder: Path) -> list[Path]:
    """Writes a skill's module, its specification and its test; returns the files.

    Args:
        name: A module's name, as my_robot.
        folder: Where to.

    Raises:
        Invalid: The name is not valid or is another module's, or a file exists or cannot be written.
    """
    module = name.removesuffix(".py")
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", module) or module.endswith("_"):
        raise Invalid(f"a skill's name is a Python module's, as my_robot: small letters, digits and _; got {name!r}")
    target = folder.absolute()
    words = module.split("_")
    named = {
        "my_robot": module,
        "my-robot": task_name(module),
        "MyRobot": "".join(word.capitalize() for word in words),
    }
    made = [target / file.replace("my_robot", module).removesuffix(".txt") for file in _FILES]
    if there := [path for path in made if path.exists()]:
        raise Invalid(f"{there[0]} is there already; choose another name or folder")
    if iskeyword(module) or module in sys.stdlib_module_names or find_spec(module) is not None:
        raise Invalid(f"{module!r} is a word or a module of Python already, which the skill would hide; choose another")
    try:
        target.mkdir(parents=True, exist_ok=True)
        for file, path in zip(_FILES, made, strict=True):
            text = files(__name__).joinpath(file).read_text(encoding="utf-8")
            with path.open("x", encoding="utf-8") as opened:
                opened.write(re.sub("|".join(named), lambda found: named[found[0]], text))
    except OSError as error:
        raise Invalid(f"{error.filename or target} cannot be written: {error.strerror}") from error
    return made
