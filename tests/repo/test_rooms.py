"""Folders and modules that a newcomer finds: nouns of the field, few to a folder, one whole idea in each.

The constants that end in MOST may only fall.
"""

import re
import tomllib
from collections import Counter
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
ROOTS: list[str] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["dev-mode-dirs"]

FULL = 15
"""Modules that a folder may hold."""

SHORT = 60
"""Lines below which a module is probably part of another."""
SHORT_FOR_A_REASON = {
    "client/crkr/client/cli/standard_streams.py": "`main` needs it before it imports rich, for --help",
    "client/crkr/client/cli/stop_request.py": "one value, used by nine loops of three roots",
    "client/crkr/client/policy.py": "the interface that robots' programs are typed by",
    "learner/crkr/learner/selection/acceleration.py": "the only module that may load compiled code",
    "protocol/crkr/protocol/earlier_python.py": "goes with Python 3.10",
    "protocol/crkr/protocol/ids.py": "one value, used by every message",
    "protocol/crkr/protocol/messages/call_metadata.py": "the attachment of a query, beside every message",
    "server/crkr/server/inspection/synthetic_log.py": "a program of its own, run with python -m",
    "server/crkr/server/installed_code.py": "one value, for the three modules that start a process",
    "server/crkr/server/learning/notices.py": "the only module of learning that knows Zenoh",
    "server/crkr/server/log/postgres/url.py": "reads URLs for commands without the extra postgres",
    "sim_worker/crkr/sim_worker/commands/oracle.py": "a command, found by its entry point, imports nothing heavy",
    "sim_worker/crkr/sim_worker/commands/plot_policy.py": "a command, found by its entry point, imports nothing heavy",
    "sim_worker/crkr/sim_worker/figure.py": "sets what Matplotlib reads as it is imported",
    "sim_worker/crkr/sim_worker/places/ray_node.py": "what Ray calls on a node, where there is no driver",
    "sim_worker/crkr/sim_worker/table_tennis/ball/flight.py": "the ball's formulas, apart from its constants",
    "sim_worker/crkr/sim_worker/table_tennis/environments/play.py": "one value that three environments give",
    "sim_worker/crkr/sim_worker/table_tennis/policy_figure.py": "Matplotlib, which no worker needs",
}
SHORT_MOST = 20
"""Modules below that length."""

NOUNS = {
    "incoming": "the ball before the hit",
    "learning": "the field's word",
    "nothing": "no verb",
    "reaching": "the field's word for moving a hand to a target",
    "recording": "a file of Rerun, a robot's motion",
    "rounding": "what floating point does",
    "swing": "no verb here: an arm's stroke",
    "timing": "measured durations",
}
"""Words in -ing that name a thing."""
PICTURES = {"crew", "desk", "duty", "guest", "reserve", "relay", "seat", "tether", "turns", "vitals"}
"""Words that say what something resembles, not what it is."""
CLASSES_MOST = 5
"""Classes of the sources that are named so."""


def modules() -> list[Path]:
    """Every module of sources and tests, relative to the repository."""
    return sorted(
        path.relative_to(REPOSITORY)
        for root in [*ROOTS, "tests"]
        for path in (REPOSITORY / root).rglob("*.py")
        if "__pycache__" not in path.parts
    )


def overfull(paths: list[Path]) -> dict[str, int]:
    counts = Counter(path.parent.as_posix() for path in paths if path.name != "__init__.py")
    return {folder: count for folder, count in counts.items() if count > FULL}


def badly_named(path: Path) -> bool:
    """Whether a module, or its folder, is called by a verb's -ing form or by a picture."""
    return any(is_no_noun(word) for part in (path.parent.name, path.stem) for word in part.split("_"))


def is_no_noun(word: str) -> bool:
    return word in PICTURES or (word.endswith("ing") and word not in NOUNS)


def badly_named_classes(source: str) -> list[str]:
    """Classes whose names have a picture anywhere, or a verb's -ing form at the end."""
    names = {name: re.findall("[A-Z]?[a-z0-9]+", name) for name in re.findall(r"^ *class (\w+)", source, re.MULTILINE)}
    return [
        name
        for name, (*first, last) in names.items()
        if is_no_noun(last.lower()) or PICTURES & {word.lower() for word in first}
    ]


def short_modules() -> dict[str, int]:
    lengths = {path.as_posix(): len((REPOSITORY / path).read_text().splitlines()) for path in modules()}
    return {
        name: length
        for name, length in lengths.items()
        if length < SHORT and not name.startswith("tests/") and not name.endswith("__.py")
    }


def test_no_folder_holds_more_modules_than_a_reader_can_scan() -> None:
    assert len(modules()) > 300
    assert overfull(modules()) == {}


def test_modules_and_folders_are_named_by_nouns_of_the_field() -> None:
    assert [path.as_posix() for path in modules() if badly_named(path)] == []


def test_classes_are_named_by_nouns_of_the_field() -> None:
    sources = [path for path in modules() if path.parts[0] != "tests"]
    bad = [f"{path}: {name}" for path in sources for name in badly_named_classes((REPOSITORY / path).read_text())]
    assert len(bad) <= CLASSES_MOST, "\n".join(bad)


def test_a_module_under_sixty_lines_has_a_reason() -> None:
    assert set(short_modules()) == set(SHORT_FOR_A_REASON)
    assert len(SHORT_FOR_A_REASON) <= SHORT_MOST


@pytest.mark.parametrize("name", ["server/filling.py", "server/test_stopping.py", "a/desk_plan.py", "refusing/a.py"])
def test_a_gerund_and_a_picture_are_found(name: str) -> None:
    assert badly_named(Path(name))


@pytest.mark.parametrize("name", ["server/learning/thread.py", "a/string.py", "a/settings.py", "a/test_desktop.py"])
def test_nouns_pass(name: str) -> None:
    assert badly_named(Path(name)) == (name == "a/string.py"), "a new word in -ing is to be listed"


def test_a_class_is_found_by_any_word_of_its_name() -> None:
    assert badly_named_classes("class JudgeSeat:\n    class _Fitting(Base): ...\nclass Deskew: ...\n") == [
        "JudgeSeat",
        "_Fitting",
    ]


def test_a_folder_of_sixteen_is_found() -> None:
    assert overfull([Path(f"a/m{number}.py") for number in range(16)]) == {"a": 16}
    assert overfull([Path(f"a/m{number}.py") for number in range(15)] + [Path("a/__init__.py")]) == {}
