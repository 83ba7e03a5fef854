"""The committed runs are what the commands make."""

import shutil
from pathlib import Path

import pytest

from crkr.experiments.rivals.comparison import Contest, train
from crkr.experiments.study.ablations import ABLATIONS
from crkr.experiments.study.approximators import Way
from crkr.experiments.study.rows import Row, Rows
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

RESULTS = Path(__file__).parents[3] / "docs" / "results"


def kept(name: str, folder: Path) -> dict[tuple[str, int, int], Row]:
    shutil.copy(RESULTS / f"{name}.csv", folder / "rows.csv")
    return {(row.way, row.seed, row.trials): row for row in Rows(folder, "rows.csv", {}).all}


@pytest.mark.parametrize("rule", ["independence", "lowest-cost", "freeze"])
def test_a_run_of_the_study_made_anew_has_the_committed_successes(rule: str, tmp_path: Path) -> None:
    way, contest = Way(rule, 50, 1.0), Contest((100,), 100, 515151, 5, "paper")
    skill = TableTennis(SkillOptions(environment="analytic", preset="paper", traces=False))
    (made,), _ = train(skill, contest, way(skill.spec(), 7300), way.name, 7300)
    # The last bits of linear algebra differ between machines, and a ball on the edge may go either way.
    assert made.successes == pytest.approx(kept("study-nominal", tmp_path)[way.name, 7300, 100].successes, abs=3)


def test_an_ablation_made_anew_has_the_committed_successes(tmp_path: Path) -> None:
    skill = TableTennis(SkillOptions(environment="analytic", launcher="wide", traces=False))
    contest, name = Contest((100,), 100, 515151, 5), "no outcome"
    (made,), _ = train(skill, contest, ABLATIONS[name](skill.spec(), 7300), name, 7300)
    assert made.successes == pytest.approx(kept("ablation-wide", tmp_path)[name, 7300, 100].successes, abs=3)
