"""Every rival keeps one contract, and those that use outcomes learn what those without cannot."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.client.cli.error_lines import guarded
from crkr.experiments.rivals.command import rivals
from crkr.experiments.rivals.comparison import PACKAGES, RIVALS, Contest, train
from crkr.experiments.rivals.rival import DESIGN
from crkr.protocol import Invalid
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

CONTEST = Contest(marks=(0, 6), contexts=8, judge=5, demonstrations=5)
TRIALS = {"botorch": 6, "global-gp": 14}  # slow ones; elsewhere more than a batch of each


@pytest.fixture(params=RIVALS)
def name(request: pytest.FixtureRequest) -> str:
    found: str = request.param
    if found in PACKAGES:
        pytest.importorskip(PACKAGES[found], reason=f"{found} needs the extra 'rivals'")
    return found


@pytest.fixture
def skill() -> TableTennis:
    return TableTennis(SkillOptions(environment="analytic"), traces=False)


def test_a_rival_answers_within_bounds_and_repeats_by_its_seed(name: str, skill: TableTennis) -> None:
    spec = skill.spec()
    low, high = (np.array([getattr(entry, side) for entry in spec.goal]) for side in ("low", "high"))

    def goals() -> np.ndarray:
        rival = RIVALS[name](spec, 3)
        rival.start(skill.demonstrations(5, np.random.default_rng(1)))
        rng, asked = np.random.default_rng(2), []
        for _ in range(TRIALS.get(name, 42)):
            state = skill.reset(rng)
            goal = rival.ask(state)
            rival.tell(state, goal, skill.execute(goal))
            asked.append(goal)
        states = np.array([skill.reset(rng) for _ in range(7)])
        before = rival.policy(states)
        np.testing.assert_array_equal(rival.policy(states), before)
        assert before.shape == (7, len(spec.goal))
        return np.concatenate([asked, before])

    found = goals()
    assert np.all((found >= low) & (found <= high))
    np.testing.assert_array_equal(goals(), found)


def test_a_run_is_judged_at_every_mark_on_the_same_contexts(name: str, skill: TableTennis) -> None:
    rows, milliseconds = train(skill, CONTEST, RIVALS[name](skill.spec(), 4), name, 4)
    assert [(row.way, row.seed, row.trials, row.contexts) for row in rows] == [(name, 4, 0, 8), (name, 4, 6, 8)]
    assert milliseconds > 0
    assert train(skill, CONTEST, RIVALS[name](skill.spec(), 4), name, 4)[0] == rows


def test_a_rival_needs_no_demonstrations(name: str, skill: TableTennis) -> None:
    contest = Contest(marks=(0, DESIGN + 3), contexts=8, judge=5, demonstrations=0)
    rows, _ = train(skill, contest, RIVALS[name](skill.spec(), 4), name, 4)
    assert [row.trials for row in rows] == [0, DESIGN + 3]


def test_a_forward_model_learns_from_one_demonstration_as_its_goals_are_varied(skill: TableTennis) -> None:
    model = RIVALS["bayesian-quadratic"](skill.spec(), 3)
    (shown,) = skill.demonstrations(1, np.random.default_rng(1))
    model.start([shown])
    asked = np.array([model.ask(shown.state) for _ in range(20)])
    assert asked.std(axis=0).min() > 0


def test_a_study_goes_on_where_it_stopped(tmp_path: Path) -> None:
    app = Typer()
    app.command()(rivals)
    words = ["--trials", "5", "--contexts", "5", "--only", "success-gp", "--jobs", "1", "--out", str(tmp_path)]
    first = CliRunner().invoke(app, [*words, "--seeds", "1", "--json"])
    assert first.exit_code == 0, first.output
    again = CliRunner().invoke(app, [*words, "--seeds", "2"])
    assert again.exit_code == 0, again.output
    assert "success-gp" in again.stdout
    with (tmp_path / "rivals.csv").open(newline="") as file:
        assert [row["seed"] for row in csv.DictReader(file)] == ["0", "1"]


def test_an_unknown_rival_lists_the_known_ones() -> None:
    app = Typer()
    app.command()(rivals)
    error = CliRunner().invoke(app, ["--only", "ppo"]).exception
    assert isinstance(error, Invalid)
    assert "no rival 'ppo'; there are: crkr, bayesian-quadratic" in str(error)


@pytest.mark.parametrize(("name", "package"), PACKAGES.items())
def test_a_rival_without_its_package_names_the_extra_before_anything_runs(
    name: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    app = Typer()
    app.command()(guarded(rivals, "experiment rivals", rivals.__module__))
    done = CliRunner().invoke(app, ["--only", name])
    assert done.exit_code == 1
    assert done.stderr == "error: crkr experiment rivals needs the extra 'rivals': pip install 'crkr[rivals]'\n"
