"""The command, as a user runs it."""

import json
from pathlib import Path

import pytest
from matplotlib.image import imread
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.learning.command import learning
from crkr.protocol import Invalid

SHORT = ["--environment", "analytic", "--trials", "12", "--balls", "10", "--first-seed", "3"]


@pytest.fixture
def app() -> Typer:
    made = Typer()
    made.command()(learning)
    return made


def test_the_number_of_processes_changes_nothing(app: Typer, tmp_path: Path) -> None:
    answers = []
    for jobs in ("1", "2"):
        result = CliRunner().invoke(
            app, [*SHORT, "--seeds", "2", "--jobs", jobs, "--json", "--out", str(tmp_path), "--overwrite"]
        )
        assert result.exit_code == 0, result.output
        answers.append(json.loads(result.stdout))
    assert answers[0] == answers[1]
    assert [run["seed"] for run in answers[0]["runs"]] == [3, 4]
    summary = answers[0]["summary"]["strict"]
    rates = [run["final"]["successes"]["strict"] / 10 for run in answers[0]["runs"]]
    assert summary["mean"] == pytest.approx(sum(rates) / 2)
    assert summary["worst"] == min(rates)
    assert json.loads((tmp_path / "learning.json").read_text())["summary"] == answers[0]["summary"]
    picture = imread(tmp_path / "learning.png")
    assert picture.shape[0] > 300
    assert picture[..., :3].std() > 0.05


def test_a_single_run_has_no_interval(app: Typer) -> None:
    result = CliRunner().invoke(app, [*SHORT, "--seeds", "1", "--no-oracle"])
    assert result.exit_code == 0, result.output
    paper = next(line.split() for line in result.stdout.splitlines() if line.startswith("paper"))
    assert " to " not in " ".join(paper)
    assert paper[-2:] == ["(seed", "3)"]


def test_launcher_preset_and_demonstrations_are_chosen_by_flags(app: Typer) -> None:
    chosen = ["--launcher", "medium", "--preset", "paper", "--demonstrations", "20"]
    results = [CliRunner().invoke(app, [*SHORT, "--seeds", "1", "--json", *more]) for more in ([], chosen)]
    default, other = (json.loads(result.stdout) for result in results)
    assert (other["options"]["launcher"], other["options"]["preset"]) == ("medium", "paper")
    assert other["course"]["demonstrations"] == 20
    assert other["runs"][0]["digest"] != default["runs"][0]["digest"]
    assert other["summary"]["strict"]["oracle"] is not None


@pytest.mark.parametrize("name", ["learning.json", "learning.png"])
def test_the_files_of_an_earlier_run_are_replaced_only_with_overwrite(app: Typer, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("of an earlier run")
    result = CliRunner().invoke(app, [*SHORT, "--seeds", "1", "--out", str(tmp_path)])
    assert isinstance(result.exception, Invalid)
    assert f"{name} exists; choose another file, or --overwrite" in str(result.exception)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["of an earlier run"]
