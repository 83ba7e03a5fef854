"""One namespace, many roots: how the parts present themselves."""

import importlib
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).parents[2]
ROOTS: list[str] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["dev-mode-dirs"]


# What the import system and lazy loading bind without meaning to offer it.
MACHINERY = {"annotations", "TYPE_CHECKING"}


def public_names(module: ModuleType) -> set[str]:
    """What a module binds for its users: all but underscored names, modules and machinery."""
    return {
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and not isinstance(value, ModuleType) and name not in MACHINERY
    }


@pytest.mark.parametrize("root", ROOTS)
def test_no_root_owns_the_namespace(root: str) -> None:
    assert not (REPOSITORY / root / "crkr" / "__init__.py").exists()
    assert [path.name for path in (REPOSITORY / root / "crkr").iterdir() if path.name != "__pycache__"] == [root]


@pytest.mark.parametrize("root", ROOTS)
def test_all_names_exactly_what_a_part_binds(root: str) -> None:
    module = importlib.import_module(f"crkr.{root}")
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        getattr(module, name)  # some parts load their names on first use
    assert public_names(module) == set(module.__all__)


@pytest.mark.parametrize("root", ROOTS)
def test_a_part_is_marked_as_typed(root: str) -> None:
    assert (REPOSITORY / root / "crkr" / root / "py.typed").exists()


def test_a_name_that_leaks_is_seen() -> None:
    module = ModuleType("part")
    exec("from __future__ import annotations\nimport os\nfrom math import pi\n_own = 1", vars(module))
    assert public_names(module) == {"pi"}
