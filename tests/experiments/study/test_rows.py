"""Rows of a comparison come back, and their summary is the interquartile mean."""

from pathlib import Path

import pytest

from crkr.experiments.study.rows import Row, Rows, summarise
from crkr.protocol import Invalid


def test_an_interquartile_mean_leaves_out_the_best_and_the_worst_quarter() -> None:
    rows = [Row("crkr", seed, 100, wins, 10) for seed, wins in enumerate([0, 6, 8, 10])]
    found = summarise([*rows, Row("crkr", 0, 500, 1, 10), Row("other", 0, 100, 1, 10)], "crkr", 100)
    assert found.mean == pytest.approx(0.7)
    assert (found.worst, found.seeds) == (0.0, 4)
    assert found.low <= found.mean <= found.high


def test_rows_come_back_and_another_experiments_file_is_refused(tmp_path: Path) -> None:
    rows = [Row("crkr", 1, 100, 3, 10), Row("success-gp", 2, 500, 4, 10)]
    for row in [*rows, rows[0]]:
        Rows(tmp_path, "rows.csv", {"judge": 1}).add([row])
    kept = Rows(tmp_path, "rows.csv", {"judge": 1})
    assert kept.all == rows
    assert list(kept.missing(["crkr", "success-gp"], [1, 2], 500)) == [("crkr", 1), ("success-gp", 1), ("crkr", 2)]
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(Invalid, match="holds another experiment"):
        Rows(tmp_path, "other.csv", {})
    (tmp_path / "cut.csv").write_text("way,seed,trials,successes,contexts\ncrkr,1,10\n")
    with pytest.raises(Invalid, match="a row cannot be read"):
        Rows(tmp_path, "cut.csv", {})


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    Rows(tmp_path, "rows.csv", {"skill": "throw", "judge": 1}).add([Row("crkr", 1, 100, 3, 10)])
    with pytest.raises(Invalid, match="holds runs with judge 1; choose another folder"):
        Rows(tmp_path, "rows.csv", {"skill": "throw", "judge": 2})
