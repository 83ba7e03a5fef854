"""The locks name exact versions and hashes of what pyproject.toml asks for, and no place to fetch them from."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
EXTRAS: dict[str, list[str]] = PYPROJECT["project"]["optional-dependencies"]
BASE: list[str] = PYPROJECT["project"]["dependencies"]
WANTED = {
    "all": [*BASE, *EXTRAS["all"]],
    "build": PYPROJECT["build-system"]["requires"],
    "dashboard": [*BASE, *EXTRAS["dashboard"]],
    "dev": [*BASE, *EXTRAS["all"], *PYPROJECT["dependency-groups"]["dev"], *PYPROJECT["build-system"]["requires"]],
    "postgres": [*BASE, *EXTRAS["postgres"]],
    "server": [*BASE, *EXTRAS["server"]],
    "sim": [*BASE, *EXTRAS["sim"]],
}
PIN = re.compile(r"[a-z0-9][a-z0-9-]*==[a-z0-9.]+(?: ; [^\\\n]+?)?(?: \\\n {4}--hash=sha256:[0-9a-f]{64})+\n")


def _text(name: str) -> str:
    return (REPOSITORY / "requirements" / f"{name}.lock").read_text()


def unexplained(text: str) -> str:
    """What is left of a lock when every pin with its hashes is taken away: nothing, in a good one."""
    return PIN.sub("", text)


def pins(text: str) -> dict[str, list[Requirement]]:
    """Name to its pinned requirements (several, if the version depends on the Python)."""
    found: dict[str, list[Requirement]] = {}
    for match in PIN.finditer(text):
        requirement = Requirement(match.group().split(" \\")[0])
        found.setdefault(canonicalize_name(requirement.name), []).append(requirement)
    return found


def flatten(requirements: list[str]) -> list[Requirement]:
    """The requirements with crkr's own extras replaced by what they list."""
    flat = []
    for requirement in map(Requirement, requirements):
        if requirement.name == "crkr":
            flat += flatten([text for extra in requirement.extras for text in EXTRAS[extra]])
        else:
            flat.append(requirement)
    return flat


def missing(text: str, requirements: list[str]) -> list[str]:
    """Requirements that a lock does not satisfy on Python 3.11 to 3.14."""
    locked, absent = pins(text), []
    for wanted in flatten(requirements):
        for minor in range(11, 15):
            environment = {"python_version": f"3.{minor}", "python_full_version": f"3.{minor}.0"}
            if wanted.marker is not None and not wanted.marker.evaluate(environment):
                continue
            versions = [
                next(iter(pin.specifier)).version
                for pin in locked.get(canonicalize_name(wanted.name), [])
                if pin.marker is None or pin.marker.evaluate(environment)
            ]
            if len(versions) != 1 or not wanted.specifier.contains(versions[0], prereleases=True):
                absent.append(f"{wanted} on 3.{minor}: {versions}")
    return absent


def test_there_is_a_lock_for_each_use_and_no_other() -> None:
    assert {path.stem for path in (REPOSITORY / "requirements").iterdir()} == set(WANTED)


@pytest.mark.parametrize("name", WANTED)
def test_a_lock_holds_hashed_pins_and_nothing_else(name: str) -> None:
    assert pins(_text(name))
    assert unexplained(_text(name)) == ""


@pytest.mark.parametrize("name", WANTED)
def test_a_lock_satisfies_what_the_project_asks_for(name: str) -> None:
    assert missing(_text(name), WANTED[name]) == []


@pytest.mark.parametrize("name", WANTED)
def test_every_lock_agrees_with_the_largest(name: str) -> None:
    largest = pins(_text("dev"))
    for package, pinned in pins(_text(name)).items():
        everywhere = [one for one in largest[package] if one.marker is None]  # which a smaller lock needs in places
        assert [one.specifier for one in pinned] == [one.specifier for one in everywhere or largest[package]]
        assert everywhere or pinned == largest[package]


HASH = "sha256:" + "0" * 64


@pytest.mark.parametrize(
    "bad",
    [
        "numpy==2.0\n",
        f"numpy>=2.0 \\\n    --hash={HASH}\n",
        f"--index-url https://mirror.invalid/simple\nnumpy==2.0 \\\n    --hash={HASH}\n",
        f"--find-links wheels\nnumpy==2.0 \\\n    --hash={HASH}\n",
        f"numpy @ file:///numpy.whl \\\n    --hash={HASH}\n",
        f"# by a tool\nnumpy==2.0 \\\n    --hash={HASH}\n",
    ],
)
def test_a_bad_lock_is_found(bad: str) -> None:
    assert unexplained(bad) != ""


def test_a_missing_or_outdated_pin_is_found() -> None:
    lock = f"numpy==2.0 \\\n    --hash={HASH}\n"
    assert missing(lock, ["numpy>=2"]) == []
    assert len(missing(lock, ["numpy>=2.1"])) == len(missing(lock, ["scipy"])) == 4
