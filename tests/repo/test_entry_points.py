"""Every command and skill that pyproject.toml promises can be loaded, and the installation knows them all."""

import importlib
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
GROUPS: dict[str, dict[str, str]] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"][
    "entry-points"
]
PROMISED = [(group, name, target) for group, names in GROUPS.items() for name, target in names.items()]


@pytest.mark.parametrize(("group", "name", "target"), PROMISED)
def test_an_entry_point_names_something_callable(group: str, name: str, target: str) -> None:
    module, _, attribute = target.partition(":")
    assert callable(getattr(importlib.import_module(module), attribute))


@pytest.mark.parametrize("group", GROUPS)
def test_the_installation_is_as_new_as_the_project(group: str) -> None:
    installed = {point.name: point.value for point in entry_points(group=group) if point.value.startswith("crkr.")}
    assert installed == GROUPS[group], "run `make setup`"
