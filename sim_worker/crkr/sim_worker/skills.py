"""Finding a skill by its installed name, or as "package.module:factory"."""

from __future__ import annotations

import importlib
import os
import sys
from importlib.metadata import entry_points
from typing import Any, Final

from crkr.protocol import Invalid, TaskSpec
from crkr.sim_worker.skill import Skill, SkillOptions

__all__ = ["GROUP", "check_skill", "installed_skills", "load_skill", "specification"]

GROUP: Final = "crkr.skills"


def installed_skills() -> tuple[str, ...]:
    """Names that installed packages offer in the entry point group `crkr.skills`, sorted."""
    return tuple(sorted(entry_points(group=GROUP).names))


def check_skill(name: str) -> str:
    """Returns `name` if it is installed or of the form "package.module:factory"; loads nothing.

    Raises:
        Invalid: Neither.
    """
    if ":" not in name and name not in installed_skills():
        listed = ", ".join(installed_skills()) or "none"
        raise Invalid(f"no skill {name!r}; installed: {listed}; one of your own is given as package.module:factory")
    return name


def load_skill(name: str, options: SkillOptions) -> Skill:
    """Makes a skill.

    Args:
        name: An installed skill's name, or "package.module:factory", looked up from the working directory too.
        options: How it is to be set up.

    Raises:
        Invalid: No such skill, or an option that it does not know.
        ModuleNotFoundError: A library that the skill needs is not installed.
    """
    factory = _from_module(name) if ":" in name else _from_entry_point(name)
    skill: Skill = factory(options)
    return skill


def specification(skill: str, /, **options: Any) -> TaskSpec:
    """What a skill made with these `SkillOptions` learns under; `crkr create` finds it by its entry point.

    Raises:
        Invalid: No such skill, or an option that it does not know.
        ModuleNotFoundError: A library that the skill needs is not installed.
    """
    return load_skill(skill, SkillOptions(**options)).spec()


def _from_entry_point(name: str) -> Any:
    check_skill(name)
    return next(iter(entry_points(group=GROUP, name=name))).load()


def _from_module(name: str) -> Any:
    module_name, _, attribute = name.partition(":")
    here = os.getcwd()
    if here not in sys.path:  # the `crkr` script, unlike `python -m`, does not look there
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise Invalid(f"skill {name!r}: there is no module {error.name!r}") from error
    factory = getattr(module, attribute, None)
    if not callable(factory):
        raise Invalid(f"skill {name!r}: module {module_name!r} has no factory {attribute!r}")
    return factory
