"""The committed runs are what the command makes."""

import shutil
from pathlib import Path

import pytest

from crkr.experiments.rivals.comparison import RIVALS, Contest, train
from crkr.experiments.study.rows import Rows
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

RESULTS = Path(__file__).parents[3] / "docs" / "results"


@pytest.mark.parametrize(("launcher", "rival"), [("wide", "success-gp"), ("medium", "contextual-reps")])
def test_a_run_made_anew_has_the_committed_successes(launcher: str, rival: str, tmp_path: Path) -> None:
    shutil.copy(RESULTS / f"rivals-{launcher}.csv", tmp_path / "rivals.csv")
    kept = {(row.way, row.seed, row.trials): row for row in Rows(tmp_path, "rivals.csv", {}).all}
    skill = TableTennis(SkillOptions(environment="analytic", launcher=launcher), traces=False)
    (made,), _ = train(skill, Contest((100,), 300, 515151, 5), RIVALS[rival](skill.spec(), 7300), rival, 7300)
    # The last bits of linear algebra differ between machines, and a ball on the edge may go either way.
    assert made.successes == pytest.approx(kept[rival, 7300, 100].successes, abs=3)
