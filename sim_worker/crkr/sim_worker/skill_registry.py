"""Skills by name: installed ones, "package.module:factory", "path/to/module.py:factory", and "gymnasium:ENV-ID"."""

from __future__ import annotations

import importlib
import os
import re
import sys
import traceback
from contextlib import chdir
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final, NoReturn, final

from crkr.protocol import CrkrError, Invalid, TaskSpec
from crkr.sim_worker.guarded_skill import GuardedSkill, one_line, skill_code
from crkr.sim_worker.skill import Skill, SkillOptions

__all__ = [
    "GROUP",
    "MissingLibrary",
    "check_skill",
    "default_task",
    "installed_skills",
    "load_skill",
    "portable_name",
    "skill_of",
    "specification",
    "task_name",
]

GROUP: Final = "crkr.skills"
FAMILIES: Final = "crkr.skill_families"
"""Entry points that make a factory from the text after their name and a colon, e.g. an environment's name."""


def installed_skills() -> tuple[str, ...]:
    """Sorted names of installed packages in the entry point group `crkr.skills`."""
    return tuple(sorted(entry_points(group=GROUP).names))


class MissingLibrary(CrkrError, ModuleNotFoundError):
    """A user's skill imports a package that is not installed."""


def check_skill(name: str) -> str:
    """Returns `name` if it names an installed skill, or a module or file with a factory; loads nothing.

    Raises:
        Invalid: It names neither.
    """
    if _family(name):
        if not name.partition(":")[2]:
            raise Invalid(f"skill {name!r} names no member; write {name}NAME")
    elif ":" in name:
        _Place.of(name)
    elif name not in installed_skills():
        listed = ", ".join(installed_skills()) or "none"
        file = Path(name).with_suffix(".py")
        found = f"; name {file} with its factory, as {file}:make" if file.is_file() else ""
        raise Invalid(f"no skill {name!r}; installed: {listed}; name your own as package.module:factory{found}")
    return name


def default_task(name: str) -> str:
    """Name of a task for a skill: the skill's, or its module's if it is not installed; raises as `check_skill`."""
    check_skill(name)
    if _family(name):
        return task_name(name)
    return name if ":" not in name else _Place.of(name).module.split(".")[-1].replace("_", "-").lower()


def task_name(member: str) -> str:
    """A task's name for a family's member, as "reacher-v5" for "gymnasium:Reacher-v5"."""
    return re.sub(r"[^a-z0-9]+", "-", member.rpartition(":")[2].lower()).strip("-")[:63] or "task"


def load_skill(name: str, options: SkillOptions) -> Skill:
    """Makes a skill.

    Args:
        name: An installed skill's name; "package.module:factory", looked up from the working directory too; or a file,
            as "path/to/module.py:factory" or "./module:factory"; or a family and its member, as "gymnasium:Reacher-v5".
        options: How to set it up.

    Raises:
        Invalid: There is no such skill, it does not know an option, or its module or factory raises.
        ModuleNotFoundError: A library that the skill needs is not installed.
    """
    look = _from_family if _family(name) else _from_module if ":" in name else _from_entry_point
    factory = look(name)

    def fault(error: BaseException) -> NoReturn:
        if isinstance(error, CrkrError | ModuleNotFoundError):
            raise error
        if isinstance(error, TypeError) and _was_not_entered(error):
            raise Invalid(
                f"{name!r} is no factory of a skill: it cannot be called with SkillOptions ({error})"
            ) from error
        raise Invalid(f"skill {name!r}: its factory raised {one_line(error)}") from error

    with skill_code(fault):
        skill: Skill = factory(options)
    lacking = [method for method in ("spec", "reset", "execute") if not callable(getattr(skill, method, None))]
    if lacking:
        kind = type(skill).__name__
        raise Invalid(f"skill {name!r}: its factory made a {kind}, which has no method {' or '.join(lacking)}")
    return skill


def portable_name(name: str) -> str:
    """A skill's name for a task's specification: a file by its absolute path."""
    place = _Place.of(name) if ":" in name and not _family(name) else None
    return name if place is None or place.file is None else f"{place.file}:{place.factory}"


def skill_of(spec: TaskSpec) -> str | None:
    """The skill that a task names, or an installed one of the task's name; None without one.

    A task may come from somebody else, so only an installed skill is loaded, code in the working directory, or a file
    of this user. A family's member that names a package, which would be imported, is not.

    Raises:
        Invalid: It names another one.
    """
    name = spec.skill
    if ":" not in name:
        return next((one for one in (name, spec.name) if one in installed_skills()), None)
    if _family(name):
        if ":" not in name.partition(":")[2]:
            return name
        raise Invalid(f"task {spec.name!r} names a package, as {name!r}; if you trust it, name the skill by --skill")
    place = _Place.of(name)
    found: Path | None = place.file
    if found is None:
        top = place.folder / place.module.partition(".")[0]
        found = next((path for path in (top.with_suffix(".py"), top) if path.exists()), None)
    if found is None or found.stat().st_uid not in (0, os.getuid()):
        raise Invalid(f"task {spec.name!r} was made for skill {name!r}, which is not here; name yours by --skill")
    return name


def _was_not_entered(error: BaseException) -> bool:
    """Whether the call itself failed, as for `os:system`, not code of a factory."""
    return error.__traceback__ is None or Path(traceback.extract_tb(error.__traceback__)[-1].filename) == Path(__file__)


def specification(skill: str, /, **options: Any) -> TaskSpec:
    """The specification of a skill with these `SkillOptions`; `crkr create` finds this function by its entry point.

    Raises:
        Invalid: There is no such skill, or it does not know an option.
        ModuleNotFoundError: A library that the skill needs is not installed.
    """
    with chdir(os.getcwd()):  # also if the skill changes the folder: the command may write to a relative path
        return replace(GuardedSkill(load_skill(skill, SkillOptions(**options))).spec(), skill=portable_name(skill))


def _from_entry_point(name: str) -> Any:
    check_skill(name)
    return next(iter(entry_points(group=GROUP, name=name))).load()


def _family(name: str) -> str | None:
    """The family that a name's member is of."""
    family, colon, _ = name.partition(":")
    return family if colon and family in entry_points(group=FAMILIES).names else None


def _from_family(name: str) -> Any:
    check_skill(name)
    family, _, member = name.partition(":")
    return next(iter(entry_points(group=FAMILIES, name=family))).load()(member)


@final
@dataclass(frozen=True, slots=True)
class _Place:
    """Location of a user's skill.

    Attributes:
        folder: Searched first.
        module: Dotted name.
        factory: Its name in the module.
        file: The module's file, where the skill was named by its file.
    """

    folder: Path
    module: str
    factory: str
    file: Path | None = None

    @classmethod
    def of(cls, name: str) -> _Place:
        """Reads a name with a colon; raises `Invalid` if the module, the factory or the file is missing."""
        where, _, factory = name.rpartition(":")
        if not where or not factory.isidentifier():
            lacks = "names no module" if not where else "names no factory"
            raise Invalid(f"skill {name!r} {lacks}; skills are named module:factory, as reach:make")
        if os.sep in where or where.endswith(".py"):
            file = Path(where if where.endswith(".py") else f"{where}.py").absolute()
            if not file.is_file():
                raise Invalid(f"skill {name!r}: there is no file {file}")
            if "." in file.stem:
                raise Invalid(f"skill {name!r}: Python imports no file with a dot in its name; rename {file.name}")
            return cls(file.parent, file.stem, factory, file)
        if not all(part.isidentifier() for part in where.split(".")):
            raise Invalid(f"skill {name!r}: {where!r} is no module's name; skills are named module:factory")
        return cls(Path.cwd(), where, factory)


# Packages that an extra of crkr brings: if one is missing, the command names the extra.
_OURS: Final = ("PIL", "av", "clarabel", "coal", "gymnasium", "matplotlib", "mujoco", "pinocchio", "scipy")


def _from_module(name: str) -> Any:
    place = _Place.of(name)
    if str(place.folder) not in sys.path:  # the `crkr` script, unlike `python -m`, does not search it
        sys.path.insert(0, str(place.folder))

    def fault(error: BaseException) -> NoReturn:
        if not isinstance(error, ModuleNotFoundError):
            raise Invalid(f"skill {name!r}: its module cannot be imported: {one_line(error)}") from error
        missing = error.name or ""
        if f"{place.module}.".startswith(f"{missing}."):
            raise Invalid(f"skill {name!r}: there is no module {missing!r}") from error
        if missing.partition(".")[0] in _OURS:
            raise error
        raise MissingLibrary(f"skill {name!r}: there is no module {missing!r}, which it imports") from error

    with skill_code(fault):
        module = importlib.import_module(place.module)
    origin = getattr(module, "__file__", None)
    if place.file is not None and (origin is None or not place.file.samefile(origin)):
        taken = f"{place.module!r} is the name of another module, {origin or 'built in'}"
        raise Invalid(f"skill {name!r}: {taken}; rename {place.file.name}")
    factory = getattr(module, place.factory, None)
    if not callable(factory):
        raise Invalid(f"skill {name!r}: module {place.module!r} has no factory {place.factory!r}")
    return factory
