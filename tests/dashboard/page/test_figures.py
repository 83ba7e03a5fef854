from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.client.tally import wilson_interval
from crkr.dashboard.page.figures import FIRST_WIDTH, KEPT, SPANS, Figures, Spans
from crkr.protocol import StoredTrial, TaskSpec

Make = Callable[..., StoredTrial]


def filled(spec: TaskSpec, trials: list[StoredTrial], page: int = 7) -> Figures:
    figures = Figures(spec)
    for first in range(0, len(trials), page):
        figures.add([figures.progress.add(stored, 0.0) for stored in trials[first : first + page]])
    return figures


@given(st.lists(st.booleans(), min_size=1, max_size=300), st.integers(1, 40))
def test_windows_count_what_a_list_of_the_trials_counts(marks: list[bool], least: int) -> None:
    spans = Spans(2)
    for trial, mark in enumerate(marks, 1):
        spans.add(np.array([trial]), np.array([int(mark)]))
    ends, counts = spans.windows(least)
    size = min(-(-len(marks) // FIRST_WIDTH), -(-least // FIRST_WIDTH) + 1) * FIRST_WIDTH
    for end, (no, yes) in zip(ends.astype(int), counts, strict=True):
        begun = (end - 1) // FIRST_WIDTH * FIRST_WIDTH + FIRST_WIDTH - size
        assert (no, yes) == (marks[begun:end].count(False), marks[begun:end].count(True))
    assert ends[-1] == len(marks)


@pytest.mark.parametrize("count", [SPANS * FIRST_WIDTH, SPANS * FIRST_WIDTH + 1, 100_000])
def test_spans_are_joined_and_no_trial_is_lost(count: int) -> None:
    spans = Spans(1)
    for first in range(1, count + 1, 1000):
        trials = np.arange(first, min(first + 1000, count + 1))
        spans.add(trials, np.zeros_like(trials))
    assert spans.total().tolist() == [count]
    assert spans.width * SPANS >= count
    assert len(spans.windows()[0]) <= SPANS


def test_success_is_the_share_of_a_window_with_its_interval(spec: TaskSpec, stored: Make) -> None:
    trials = [stored(seq, success=seq % 4 == 0) for seq in range(1, 201)]
    curve = filled(spec, trials).success("success")
    assert curve.trials[-1] == 200
    assert curve.count[-1] == 55
    good = sum(each.trial.success for each in trials[145:])
    assert curve.value[-1] == good / 55
    assert (curve.low[-1], curve.high[-1]) == wilson_interval(good, 55)


def test_evaluations_are_not_training(spec: TaskSpec, stored: Make) -> None:
    figures = filled(spec, [stored(seq, "evaluation", info={"epoch": 0}) for seq in range(1, 20)])
    assert len(figures.newest) == 0
    assert len(figures.success("success").trials) == 0
    assert figures.progress.epochs[0].balls == 19


def test_the_middle_and_the_spread_of_costs_are_right_to_a_cell(spec: TaskSpec, stored: Make) -> None:
    costs = np.random.default_rng(1).uniform(size=400) ** 2
    curve = filled(spec, [stored(seq, cost=float(cost)) for seq, cost in enumerate(costs, 1)]).cost()
    wanted = np.quantile(costs[-55:], [0.1, 0.5, 0.9])
    assert np.allclose([curve.low[-1], curve.value[-1], curve.high[-1]], wanted, atol=0.06)


def test_shares_of_reasons_add_up_to_one(spec: TaskSpec, stored: Make) -> None:
    names = ["hit", "net", "out"]
    figures = filled(spec, [stored(seq, info={"reason": names[seq % 3]}) for seq in range(1, 120)])
    trials, shares = figures.reasons()
    assert set(shares) == set(names)
    assert np.allclose(sum(shares.values()), np.ones(len(trials)))


def test_more_reasons_than_have_room_count_as_other(spec: TaskSpec, stored: Make) -> None:
    figures = filled(spec, [stored(seq, info={"reason": f"reason {seq}"}) for seq in range(1, 500)])
    shares = figures.reasons()[1]
    assert "other" in shares
    assert len(shares) <= 25
    assert shares["other"][-1] == 1.0


def test_only_the_newest_trials_are_kept_one_by_one(spec: TaskSpec, stored: Make) -> None:
    figures = filled(spec, [stored(seq, success=seq > 100) for seq in range(1, KEPT + 101)], page=1000)
    assert len(figures.newest) == KEPT
    assert figures.newest.success.all()


def test_an_empty_run_has_empty_curves(spec: TaskSpec) -> None:
    figures: Any = Figures(spec)
    assert len(figures.cost().trials) == 0
    assert figures.reasons()[1] == {}
