"""Sources named in docstrings lead to the page of references."""

from __future__ import annotations

import re
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
ROOTS = ("protocol", "learner", "client", "server", "sim_worker", "dashboard", "experiments")
KEY = re.compile(r"\[((?:[A-Z][A-Za-z]+\d{4}|FIPS\d+|RFC\d+))(?:, [^\]]*)?\]")


def keys_in(text: str) -> set[str]:
    return set(KEY.findall(text))


def listed() -> set[str]:
    page = (REPOSITORY / "docs/references.md").read_text()
    return set(re.findall(r"^\| (\w+) \|", page, re.MULTILINE)) - {"key"}


def test_a_key_is_found_with_and_without_an_equation() -> None:
    assert keys_in("as [Cardoso2017, eq. 8] and [RFC9562]; not array[Size20] or [a, b]") == {
        "Cardoso2017",
        "RFC9562",
    }


def test_every_source_that_the_code_names_is_listed() -> None:
    named = {
        key: path.relative_to(REPOSITORY)
        for root in ROOTS
        for path in (REPOSITORY / root).rglob("*.py")
        for key in keys_in(path.read_text())
    }
    assert named, "the search found no key at all"
    assert {key: str(path) for key, path in named.items() if key not in listed()} == {}
