"""What the figure says, as its SVG has it."""

import re
from collections import Counter
from pathlib import Path

import pytest

from crkr.client.tally import Tally
from crkr.experiments.figures.curves import draw_learning
from crkr.experiments.learning.run import LearningRun, Score

MARKS = (0, 25, 50, 100, 750, 1000, 1250, 1500)


def _run(seed: int) -> LearningRun:
    tallies = [Tally(100, Counter(hit=100), Counter(hit=50 + seed + index)) for index in range(len(MARKS))]
    scores = tuple(Score(marks, tally, {}) for marks, tally in zip(MARKS, tallies, strict=True))
    return LearningRun(seed, scores[-1], scores, {}, None, "")


@pytest.fixture
def texts(tmp_path: Path) -> list[str]:
    """Every text of a figure of two runs; Matplotlib names each beside its outlines."""
    path = tmp_path / "learning.svg"
    draw_learning([_run(1), _run(2)], {"hit": 0.75}, "a skill", path)
    return re.findall(r"<!-- (.*?) -->", path.read_text())


def test_every_line_and_band_is_named(texts: list[str]) -> None:
    assert {"a skill", "hit: mean and range of 2 runs", "hit: planner, 0.750"} <= set(texts)
    assert "success rate in 100 contexts" in texts


def test_labels_of_the_trials_do_not_run_into_each_other(texts: list[str]) -> None:
    assert [int(text) for text in texts if text.isdigit()] == [1500, 1000, 100, 50, 25, 0]


def test_one_run_has_no_range(tmp_path: Path) -> None:
    path = tmp_path / "learning.svg"
    draw_learning([_run(1)], {}, "a skill", path)
    assert "<!-- hit: one run -->" in path.read_text()
