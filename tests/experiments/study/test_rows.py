"""Rows of a comparison come back, and their summary is the interquartile mean."""

from pathlib import Path

import pytest

from crkr.experiments.study.rows import Row, Rows, compare, summarise
from crkr.protocol import Invalid


def test_an_interquartile_mean_leaves_out_the_best_and_the_worst_quarter() -> None:
    rows = [Row("crkr", seed, 100, wins, 10) for seed, wins in enumerate([0, 6, 8, 10])]
    found = summarise([*rows, Row("crkr", 0, 500, 1, 10), Row("other", 0, 100, 1, 10)], "crkr", 100)
    assert found.mean == pytest.approx(0.7)
    assert (found.worst, found.seeds) == (0.0, 4)
    assert found.low <= found.mean <= found.high


def test_ways_are_compared_seed_by_seed_and_over_strata() -> None:
    wins = {"a": (1, 5, 9, 9), "b": (0, 4, 9, 8), "c": (9, 9, 9, 9), "d": (0, 0, 0, 0)}
    rows = [Row(way, seed, 10, won, 10) for way, each in wins.items() for seed, won in enumerate(each)]
    found = compare([*rows, Row("a", 9, 10, 0, 10)], [("a", "b")], 10)
    assert found is not None
    assert found.gain[0] == pytest.approx(0.1)
    assert found.better[0] == pytest.approx((1 + 1 + 0.5 + 1) / 4)
    assert found.seeds == 4
    assert found.gain[1] <= found.gain[0] <= found.gain[2]
    both = compare(rows, [("a", "b"), ("c", "d")], 10)
    assert both is not None
    assert both.better[0] == pytest.approx((3.5 + 4) / 8)
    assert compare(rows, [("a", "e")], 10) is None


def test_the_area_under_a_curve_is_its_mean_over_the_trials() -> None:
    rows = [Row("flat", 0, mark, 5, 10) for mark in (100, 200, 500)]
    rows += [Row("late", 0, mark, won, 10) for mark, won in ((100, 0), (200, 0), (500, 10), (1000, 10))]
    found = compare(rows, [("late", "flat")], 500, area=True)
    assert found is not None
    assert found.gain[0] == pytest.approx(300 * 0.5 / 400 - 0.5)


def test_rows_of_the_file_do_not_tell_the_order_of_the_runs(tmp_path: Path) -> None:
    texts = []
    for name, order in (("one", (1, 2)), ("two", (2, 1))):
        rows = Rows(tmp_path / name, "rows.csv", {})
        for seed in order:
            rows.add([Row("crkr", seed, 100, seed, 10)])
        rows.sort()
        texts.append((tmp_path / name / "rows.csv").read_text())
    assert texts[0] == texts[1]


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
