"""The figures of the paper, as a user draws them; what is in them is checked by other means than drew it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.figures.command import figure3, figure4, figure5, figure7, policy
from crkr.experiments.figures.method import WIDTH, exploration_moments


@pytest.fixture
def app() -> Typer:
    made = Typer()
    for command in (figure3, figure4, figure5, figure7, policy):
        made.command(command.__name__)(command)
    return made


def run(app: Typer, *words: str) -> str:
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == 0, result.output
    return result.stdout


def assert_drawn(path: Path) -> None:
    picture = imread(path)
    assert picture.shape[0] > 300
    assert picture[..., :3].std() > 0.05


@pytest.mark.parametrize("name", ["figure3", "figure4"])
def test_a_figure_of_the_method_takes_no_simulation(app: Typer, tmp_path: Path, name: str) -> None:
    run(app, name, "--out", str(tmp_path / "new" / "folder"))
    assert_drawn(tmp_path / "new" / "folder" / f"{name}.png")


def test_an_existing_figure_is_replaced_only_with_overwrite(app: Typer, tmp_path: Path) -> None:
    figure = tmp_path / "figure3.png"
    figure.write_text("of an earlier run")
    result = CliRunner().invoke(app, ["figure3", "--out", str(tmp_path)])
    assert "exists; choose another file, or --overwrite" in str(result.exception)
    assert figure.read_text() == "of an earlier run"
    run(app, "figure3", "--out", str(tmp_path), "--overwrite")
    assert_drawn(figure)


def test_exploration_narrows_around_what_was_cheap() -> None:
    first, some, many = exploration_moments(4)
    assert (first.iterations, some.iterations, many.iterations) == (0, 5, 50)
    assert [len(moment.costs) for moment in (first, some, many)] == [1, 6, 51]
    misses = many.goals - (np.sin(many.states) + 0.3 * many.states)
    np.testing.assert_allclose(many.costs, 1 - np.exp(-(misses**2) / (2 * WIDTH**2)), rtol=0, atol=1e-12)
    assert first.sigma.mean() > some.sigma.mean() > many.sigma.mean()
    target = np.sin(first.shown) + 0.3 * first.shown
    errors = [np.abs(moment.mean - target).mean() for moment in (first, some, many)]
    assert errors[2] < 0.5 * errors[0]
    again = exploration_moments(4)[2]
    np.testing.assert_array_equal(again.goals, many.goals)


def test_learning_past_the_budget_differs_from_stopping_at_it_once_it_is_filled(app: Typer, tmp_path: Path) -> None:
    def drawn(trials: int) -> dict[str, Any]:
        words = [
            "--seeds",
            "2",
            "--trials",
            str(trials),
            "--budget",
            "20",
            "--balls",
            "20",
            "--jobs",
            "1",
            "--overwrite",
            "--out",
            str(tmp_path),
        ]
        answer = json.loads(run(app, "figure5", *words, "--json"))
        assert json.loads((tmp_path / "figure5.json").read_text()) == answer
        assert_drawn(tmp_path / "figure5.png")
        ways: dict[str, Any] = answer["ways"]
        return ways

    short = drawn(15)
    assert len({tuple(way["digests"]) for way in short.values()}) == 1, "all learn alike while there is room"
    assert [way["filled"] for way in short.values()] == [None] * 3
    assert all(way["curve"]["trials"] == [0, 15] for way in short.values())
    longer = drawn(60)
    assert len({tuple(way["digests"]) for way in longer.values()}) == 3
    for way in longer.values():
        assert 15 < way["filled"] < 60
        assert way["mean"] == pytest.approx(np.mean(way["final"]))
        assert way["mean"] > np.mean([rates[0] for rates in way["curve"]["rates"]])


def test_a_curve_is_drawn_for_each_tradeoff(app: Typer, tmp_path: Path) -> None:
    words = [
        "--lambda",
        "0.5,2",
        "--seeds",
        "1",
        "--trials",
        "10",
        "--balls",
        "5",
        "--jobs",
        "1",
        "--out",
        str(tmp_path),
        "--json",
    ]
    ways = json.loads(run(app, "figure7", *words))["ways"]
    assert list(ways) == ["lambda 0.5", "lambda 2"]
    assert ways["lambda 0.5"]["digests"] != ways["lambda 2"]["digests"]


@pytest.mark.parametrize("values", ["", "a,b", "1,,2", "0", "-1"])
def test_tradeoffs_that_make_no_sense_are_refused(app: Typer, tmp_path: Path, values: str) -> None:
    words = ["figure7", "--lambda", values, "--seeds", "1", "--trials", "1", "--jobs", "1", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code != 0
    assert "lambda" in str(result.exception) or "regularisation" in str(result.exception)


def test_a_policy_is_learned_and_drawn(app: Typer, tmp_path: Path) -> None:
    run(app, "policy", "--environment", "analytic", "--trials", "30", "--vary", "ball_z", "--out", str(tmp_path))
    assert_drawn(tmp_path / "policy.png")
