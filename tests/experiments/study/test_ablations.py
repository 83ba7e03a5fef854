"""Every ablation learns, and differs from the learner by what its name says."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.rivals.comparison import Contest, train
from crkr.experiments.rivals.rival import Crkr
from crkr.experiments.study.ablations import ABLATIONS, CHANGED_AFTER
from crkr.experiments.study.command import ablation
from crkr.protocol import Invalid
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


@pytest.fixture(scope="module")
def skill() -> TableTennis:
    return TableTennis(SkillOptions(environment="analytic", launcher="wide"), traces=False)


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_learns(name: str, skill: TableTennis) -> None:
    assert pickle.dumps(ABLATIONS[name])  # as it goes to another process
    rows, _ = train(skill, Contest((12,), 2, 3, 5), ABLATIONS[name](skill.spec(), 1), name, 1)
    assert [(row.trials, row.contexts) for row in rows] == [(12, 2)]


@pytest.mark.parametrize("deaths", [1, 2])
def test_runs_of_a_process_that_died_are_told_and_made_once_more(deaths: int, tmp_path: Path) -> None:
    (tmp_path / "mortal.py").write_text(
        f"""import os, pathlib
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

def make(options):
    died = pathlib.Path({str(tmp_path / "died")!r})
    count = len(died.read_text()) if died.exists() else 0
    if count < {deaths}:
        died.write_text("x" * (count + 1))
        os._exit(1)
    return TableTennis(options)
"""
    )
    app = Typer()
    app.command()(ablation)
    words = ["--seeds", "1", "--trials", "6", "--contexts", "2", "--jobs", "1", "--only", "no outcome"]
    done = CliRunner().invoke(app, [*words, "--skill", f"{tmp_path / 'mortal.py'}:make"])
    told = "a process was lost with 1 runs not made, in one of the first: no outcome, seed 0; {'skill':"
    if deaths == 1:
        assert done.exit_code == 0, done.output
        assert told in " ".join(done.stderr.split())
    else:
        assert told in str(done.exception)


def test_nothing_left_out_is_the_learner(skill: TableTennis) -> None:
    contest = Contest((20,), 20, 3, 5)
    whole, _ = train(skill, contest, ABLATIONS["whole"](skill.spec(), 1), "crkr", 1)
    assert whole == train(skill, contest, Crkr(skill.spec(), 1), "crkr", 1)[0]


def test_a_changed_robot_executes_another_goal_than_was_learned(skill: TableTennis) -> None:
    spec, rng = skill.spec(), np.random.default_rng(0)
    shown = skill.demonstrations(3, rng)
    changed, whole = (ABLATIONS[name](spec, 1) for name in ("robot changes", "whole"))
    for learner in (changed, whole):
        learner.start(shown)
    states = np.array([one.state for one in shown])
    np.testing.assert_array_equal(changed.policy(states), whole.policy(states))
    for _ in range(CHANGED_AFTER):
        for learner in (changed, whole):
            learner.tell(states[0], learner.ask(states[0]), shown[0].result)
    moved = changed.policy(states) - whole.policy(states)
    np.testing.assert_allclose(moved[:, 0], spec.scales[0])
    np.testing.assert_array_equal(moved[:, 1:], 0.0)


def test_ablations_are_listed_and_repeat_and_another_experiments_folder_is_refused(tmp_path: Path) -> None:
    app = Typer()
    app.command()(ablation)
    error = CliRunner().invoke(app, ["--only", "nonsense"]).exception
    assert isinstance(error, Invalid)
    assert "no ablation 'nonsense'; there are: whole, no outcome" in str(error)
    words = ["--seeds", "1", "--trials", "10", "--contexts", "3", "--jobs", "1"]
    for name in ("once", "again"):
        chosen = ["--launcher", "wide", "--only", "whole", "--only", "no outcome", "--out", str(tmp_path / name)]
        done = CliRunner().invoke(app, [*words, *chosen])
        assert done.exit_code == 0, done.output
    assert (tmp_path / "once/ablation.csv").read_bytes() == (tmp_path / "again/ablation.csv").read_bytes()
    assert (tmp_path / "once/ablation.png").exists()
    error = CliRunner().invoke(app, [*words, "--launcher", "medium", "--out", str(tmp_path / "once")]).exception
    assert isinstance(error, Invalid)
    assert "holds runs with launcher wide; choose another folder" in str(error)
