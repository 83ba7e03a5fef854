"""Programs and commands of the documents run as they are printed."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbclient
import nbformat
import pytest
from PIL import Image
from processes import RunningServer
from typer.main import get_command

from crkr.client.cli.subcommands import build

REPOSITORY = Path(__file__).parents[2]
PAGES = sorted([REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")])
ENDPOINT = "tcp/127.0.0.1:7447"


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)


def commands(block: str) -> Iterator[list[str]]:
    """Words of each `crkr` command of a shell block."""
    for line in block.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["crkr"]:
            yield words[1:]


def crkr_lines(page: Path) -> Iterator[list[str]]:
    """Words of each `crkr` command of a page's shell blocks."""
    for block in blocks(page, "sh"):
        yield from commands(block)


def crkr(*words: str, folder: Path, endpoint: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "crkr.client", *words]
    environment = {**os.environ, "CRKR_CONNECT": endpoint}
    return subprocess.run(command, capture_output=True, text=True, timeout=90, check=False, cwd=folder, env=environment)


def test_the_tutorial_leads_from_nothing_to_a_learned_skill_and_its_page(server: RunningServer, tmp_path: Path) -> None:
    tutorial = REPOSITORY / "docs" / "tutorial.md"
    (skill,) = blocks(tutorial, "python")
    assert len([line for line in skill.splitlines() if line.strip()]) <= 40
    told: dict[str, str] = {}
    for language, block in re.findall(r"```(\w+)\n(.*?)```", tutorial.read_text(), re.DOTALL):
        if language != "sh":
            (tmp_path / {"toml": "my_robot.toml", "python": "my_robot.py"}[language]).write_text(block)
            continue
        for words in commands(block):
            if words[0] in ("server", "watch"):  # the fixture's, and a viewer
                continue
            done = crkr(*words, folder=tmp_path, endpoint=server.endpoint)
            assert done.returncode == 0, (words, done.stderr)
            assert "Traceback" not in done.stderr
            assert not re.search(r"^(warning|problem)", done.stdout, re.MULTILINE), done.stdout
            told[words[0]] = done.stdout + done.stderr
    assert next(iter(told)) == "new"
    success = re.search(r"success +([\d.]+)%", told["evaluate"])
    assert success is not None
    assert float(success[1]) >= 90.0
    assert "outside its box" in told["predict"]
    with Image.open(tmp_path / "film.gif") as film:
        assert getattr(film, "n_frames", 1) > 5
    page = (tmp_path / "report.html").read_text()
    assert "my-robot" in page
    assert "Worst trial" in page


def test_a_person_labels_a_robots_trials(
    server: RunningServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = iter(["1.0", "h", "2.0", "m", "q"])
    monkeypatch.setattr("builtins.input", lambda _: next(answers))
    (program,) = blocks(REPOSITORY / "docs" / "robot.md", "python")
    assert ENDPOINT in program
    exec(compile(program.replace(ENDPOINT, server.endpoint), "robot.md", "exec"), {})
    assert capsys.readouterr().out.splitlines()[-1].startswith("{'trial': 2,")


def test_the_notebook_runs_from_top_to_bottom() -> None:
    read: Any = nbformat.read
    notebook = read(REPOSITORY / "examples" / "learning.ipynb", as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "it is kept without outputs"
    # Another test may have chosen a figure's backend, which the kernel's own would not replace.
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    nbclient.NotebookClient(notebook, timeout=60, kernel_name="python3").execute(env=environment)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    said = "".join(output.get("text", "") for output in outputs if output.get("name") == "stdout")
    first, last, hit = (int(share) for share in re.findall(r"(\d+)%", said))
    assert first <= 50
    assert last >= 80
    assert hit >= 80
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_command_of_a_page_exists_with_its_options(page: Path) -> None:
    root: Any = get_command(build(["--help"]))
    wrong = []
    for words in crkr_lines(page):
        command, rest = root, list(words)
        while rest and rest[0] in getattr(command, "commands", {}):
            command = command.commands[rest.pop(0)]
        known = {name for option in command.params for name in (*option.opts, *option.secondary_opts)}
        known |= {"--help", "-h"}
        unknown = [word for word in rest if re.match(r"--?[a-z]", word) and word.partition("=")[0] not in known]
        if command is root or unknown:
            wrong.append(words)
    assert wrong == []


def test_every_command_has_an_example_that_calls_it() -> None:
    root: Any = get_command(build(["--help"]))
    every = dict(root.commands)
    for group, parent in root.commands.items():
        every |= {f"{group} {name}": each for name, each in getattr(parent, "commands", {}).items()}
    assert len(every) > 40
    assert [name for name, each in every.items() if not re.search(rf"Example: .*\bcrkr {name}\b", each.help)] == []


def test_every_page_with_a_program_is_run_by_a_test() -> None:
    tests = "\n".join(path.read_text() for path in (REPOSITORY / "tests").rglob("test_*.py"))
    lacking = [page.name for page in PAGES if blocks(page, "python") and f'{page.name}"' not in tests]
    assert lacking == []
