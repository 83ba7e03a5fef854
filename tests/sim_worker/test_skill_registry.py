"""Skills by name."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from crkr.protocol import Invalid
from crkr.sim_worker import SkillOptions, installed_skills, load_skill
from crkr.sim_worker.skill_registry import check_skill, default_task

HERE = Path(__file__).parent

pytestmark = pytest.mark.usefixtures("skills_here")


def test_the_shipped_skill_is_installed() -> None:
    assert "table-tennis" in installed_skills()


def test_a_skill_of_ones_own_is_found_by_module_and_factory() -> None:
    assert load_skill("reaching:make", SkillOptions(name="mine")).spec().name == "mine"


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("tabel-tennis", "installed: .*table-tennis"),
        ("no_such_module:make", "no module 'no_such_module'"),
        ("reaching:build", "no factory 'build'"),
        ("reaching:REACH", "no factory 'REACH'"),
    ],
)
def test_a_skill_that_is_not_there_is_refused_with_what_is(name: str, complaint: str) -> None:
    with pytest.raises(Invalid, match=complaint):
        load_skill(name, SkillOptions())


def test_a_library_that_a_skill_lacks_is_not_mistaken_for_the_skill() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        load_skill("skill_without_library:make", SkillOptions())


@pytest.mark.parametrize(
    "name", ["./reaching:make", "reaching.py:make", f"{HERE.name}/reaching.py:make", f"{HERE}/reaching:make"]
)
def test_a_skill_of_ones_own_is_found_by_its_file(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(HERE.parent if name.startswith(HERE.name) else HERE)
    assert check_skill(name) == name
    assert default_task(name) == "reaching"
    assert load_skill(name, SkillOptions(name="mine")).spec().name == "mine"


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        (":make", "names no module; skills are named module:factory"),
        ("reaching:", "names no factory"),
        ("reaching", "name reaching.py with its factory, as reaching.py:make"),
        ("./no_such_file:make", "there is no file"),
        ("no_such_file.py:make", "there is no file"),
        (".reaching:make", "no module's name"),
        ("a..b:make", "no module's name"),
        ("reaching:make this", "names no factory"),
        (":", "names no module"),
    ],
)
def test_a_malformed_name_is_refused_with_the_right_form(
    monkeypatch: pytest.MonkeyPatch, name: str, complaint: str
) -> None:
    monkeypatch.chdir(HERE)
    for look in (check_skill, lambda name: load_skill(name, SkillOptions())):
        with pytest.raises(Invalid, match=complaint):
            look(name)


def test_a_file_whose_name_another_module_has_is_refused(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("def make(options): ...")
    with pytest.raises(Invalid, match=r"the name of another module.*rename json\.py"):
        load_skill(f"{tmp_path}/json.py:make", SkillOptions())


@pytest.mark.parametrize(
    ("source", "complaint"),
    [
        ("1 / 0", "cannot be imported: ZeroDivisionError: division by zero (broken.py, line 1)"),
        ("def make(", "cannot be imported: SyntaxError"),
        ("raise SystemExit(0)", "cannot be imported: SystemExit: 0"),
        ("import no_such_library", "there is no module 'no_such_library', which it imports"),
        ("make = 3", "has no factory 'make'"),
        ("def make(options): raise SystemExit(0)", "its factory raised SystemExit: 0"),
        ("def make(options): return options.wings", "its factory raised AttributeError"),
        ("def make(): ...", "is no factory of a skill: it cannot be called with SkillOptions (make() takes 0"),
        (
            "from os import system as make",
            "is no factory of a skill: it cannot be called with SkillOptions",
        ),
        ("def make(options): return 1 + None", "its factory raised TypeError: unsupported operand"),
        ("def make(options): ...", "its factory made a NoneType, which has no method spec or reset or execute"),
        ("class make:\n def __init__(self, options): pass\n def reset(self, rng): ...", "no method spec or execute"),
    ],
)
def test_a_skill_that_cannot_be_made_is_one_line(tmp_path: Path, source: str, complaint: str) -> None:
    (tmp_path / "broken.py").write_text(source)
    command = [sys.executable, "-m", "crkr.client", "create", "--skill", "./broken:make", "--write", "-"]
    done = subprocess.run(command, cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert complaint in line


def test_a_thread_of_a_skill_does_not_keep_the_command(tmp_path: Path) -> None:
    source = f"""
import sys, threading
sys.path.append({str(HERE)!r})
from reaching import make
threading.Thread(target=threading.Event().wait).start()
"""
    (tmp_path / "threaded.py").write_text(source)
    command = [sys.executable, "-m", "crkr.client", "create", "--skill", "threaded:make", "--write", "-"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("{")


def test_a_skills_prints_go_to_standard_error(tmp_path: Path) -> None:
    (tmp_path / "loud.py").write_text(
        f"import sys\nsys.path.append({str(HERE)!r})\nprint('loading')\nfrom reaching import make"
    )
    command = [sys.executable, "-m", "crkr.client", "create", "--skill", "loud:make", "--write", "-"]
    done = subprocess.run(command, cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True, check=False)
    assert done.stdout.startswith("{"), done.stderr
    assert done.stderr == "loading\n"
