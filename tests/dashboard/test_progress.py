from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.dashboard.progress import MAX_EPOCHS, MAX_NAMES, QUIET_S, Progress, Window
from crkr.protocol import StoredTrial

Make = Callable[..., StoredTrial]


def evaluation(stored: Make, seq: int, epoch: int, paper: bool = True) -> StoredTrial:
    return stored(seq, "evaluation", info={"epoch": epoch, "outcomes": {"paper": paper}})


def test_training_trials_and_failed_ones_are_numbered_and_others_are_not(stored: Make) -> None:
    progress = Progress()
    kinds = ["demonstration", "trial", "evaluation", "failed", "trial"]
    rows = [
        progress.add(stored(seq, kind, success=kind != "failed", cost=None if kind == "failed" else 0.5), 0.0)
        for seq, kind in enumerate(kinds, 1)
    ]
    assert [row.trial for row in rows] == [0, 1, 1, 2, 3]
    assert progress.kinds == {"demonstration": 1, "trial": 2, "evaluation": 1, "failed": 1}


def test_an_evaluation_ends_when_it_has_as_many_balls_as_the_one_before(stored: Make) -> None:
    progress = Progress()
    for seq in range(1, 5):
        progress.add(evaluation(stored, seq, 0, paper=seq % 2 == 0), now=0.0)
    assert progress.finished_epochs(now=1.0) == []
    (first,) = progress.finished_epochs(now=1.0 + QUIET_S)
    assert (first.epoch, first.balls, first.tally.rate("paper")) == (0, 4, 0.5)
    for seq in range(5, 8):
        progress.add(evaluation(stored, seq, 1), now=10.0)
        assert progress.finished_epochs(now=10.0) == []
    progress.add(evaluation(stored, 8, 1), now=10.0)
    (second,) = progress.finished_epochs(now=10.0)
    assert (second.epoch, second.tally.rate("paper")) == (1, 1.0)
    assert progress.finished_epochs(now=99.0) == []


def test_evaluations_of_two_epochs_may_come_interleaved(stored: Make) -> None:
    progress = Progress()
    for seq, epoch in enumerate([3, 4, 3, 4, 4, 3], 1):
        progress.add(evaluation(stored, seq, epoch), now=0.0)
    assert [result.balls for result in progress.finished_epochs(now=2 * QUIET_S)] == [3, 3]


def test_an_evaluation_stands_at_the_trials_that_its_model_knew(stored: Make) -> None:
    progress = Progress()
    for seq in range(11, 21):
        progress.add(stored(seq), 0.0)
    late = stored(21, "evaluation", info={"epoch": 0}, model_version=14)
    assert progress.add(late, 0.0).trial == 10
    assert progress.epochs[0].trial == 4
    progress.add(stored(22, "evaluation", info={"epoch": 1}), 0.0)
    assert progress.epochs[1].trial == 10


def test_training_belongs_to_the_epoch_after_the_newest_evaluation(stored: Make) -> None:
    progress = Progress()
    assert progress.add(stored(1), 0.0).epoch == 0
    progress.add(evaluation(stored, 2, 6), 0.0)
    assert progress.add(stored(3), 0.0).epoch == 7
    assert progress.add(stored(4, info={"epoch": 2}), 0.0).epoch == 2


@pytest.mark.parametrize("odd", [{}, {"epoch": None}, {"epoch": 7.0}, {"epoch": "7"}, {"epoch": True}, {"epoch": -1}])
def test_an_evaluation_without_an_epoch_is_counted_by_kind_and_moves_no_curve(
    stored: Make, odd: dict[str, Any]
) -> None:
    progress = Progress()
    progress.add(evaluation(stored, 1, 4), 0.0)
    by_hand = {"ball": 0, "seed": 7, "outcomes": {"paper": False}}
    rows = [progress.add(stored(seq, "evaluation", info=by_hand | odd), 0.0) for seq in range(2, 52)]
    assert progress.kinds == {"evaluation": 51}
    assert {row.epoch for row in rows} == {5}
    assert progress.add(stored(52), 0.0).epoch == 5
    (result,) = progress.finished_epochs(now=2 * QUIET_S)
    assert (result.epoch, result.balls, result.tally.rate("paper")) == (4, 1, 1.0)


def test_every_criterion_that_a_skill_names_is_kept_apart(stored: Make) -> None:
    progress = Progress()
    progress.add(stored(1, info={"outcomes": {"paper": True, "strict": False}}), 0.0)
    row = progress.add(stored(2, info={"outcomes": {"paper": True, "strict": True}}), 0.0)
    assert row.rates == {"paper": 1.0, "strict": 0.5}


def test_a_skill_without_criteria_has_its_success(stored: Make) -> None:
    assert Progress().add(stored(1, success=False), 0.0).outcomes == {"success": False}


@pytest.mark.parametrize(
    "info",
    [
        {"epoch": "three", "reason": 7, "outcomes": 1},
        {"epoch": -1, "outcomes": {"paper": "yes"}},
        {"epoch": True, "reason": "", "outcomes": {}},
        {"epoch": 2**40, "reason": "x" * 5000, "outcomes": {"n" * 5000: True}},
    ],
)
def test_unreadable_info_is_ignored(stored: Make, info: dict[str, Any]) -> None:
    row = Progress().add(stored(1, info=info), 0.0)
    assert row.epoch == 0
    assert len(row.reason) <= 48
    assert all(len(name) <= 32 for name in row.outcomes)


def test_endless_new_names_do_not_grow_the_tables(stored: Make) -> None:
    progress = Progress()
    for seq in range(1, 200):
        info = {"reason": f"reason {seq}", "outcomes": {f"criterion {seq}": True}}
        progress.add(stored(seq, info=info, worker=f"worker {seq}"), 0.0)
    assert len(progress.reasons) <= MAX_NAMES + 1
    assert len(progress.workers) <= MAX_NAMES + 1
    assert len(progress.criteria) <= MAX_NAMES
    assert progress.reasons["other"] == 199 - MAX_NAMES


def test_a_trial_counts_only_for_the_criteria_that_it_states(stored: Make) -> None:
    progress = Progress()
    progress.add(stored(1, "trial", success=False), 0.0)  # reported by hand, beside workers that name criteria
    for seq in range(2, 10, 2):
        progress.add(stored(seq, "trial", success=True, info={"outcomes": {"paper": seq > 4}}), 0.0)
        progress.add(evaluation(stored, seq + 1, 0, paper=seq != 2), 0.0)
    assert (progress.window.rate("paper"), progress.window.rate("success")) == (0.5, 0.0)
    (result,) = progress.finished_epochs(now=2 * QUIET_S)
    assert (list(result.tally.criteria), result.tally.rate("paper")) == (["paper"], 0.75)


def test_the_number_of_epochs_in_memory_is_bounded(stored: Make) -> None:
    progress = Progress()
    for seq in range(1, MAX_EPOCHS + 50):
        progress.add(stored(seq, "evaluation", info={"epoch": 7919 * seq}), 10.0 * seq)
        progress.finished_epochs(10.0 * seq)
    assert len(progress.epochs) == MAX_EPOCHS
    assert max(progress.epochs) == 7919 * (MAX_EPOCHS + 49)


trials = st.tuples(
    st.none() | st.floats(0, 1), st.dictionaries(st.sampled_from("ab"), st.booleans()), st.sampled_from("xyz")
)


@given(st.lists(trials, max_size=40), st.integers(1, 10))
def test_a_window_equals_a_count_of_its_trials(
    history: list[tuple[float | None, dict[str, bool], str]], size: int
) -> None:
    window = Window(size)
    for trial in history:
        window.add(*trial)
    kept = history[-size:]
    costs = [cost for cost, _, _ in kept if cost is not None]
    assert len(window) == len(kept)
    assert window.mean_cost() == (pytest.approx(sum(costs) / len(costs)) if costs else None)
    for name in "ab":
        met = [outcomes[name] for _, outcomes, _ in kept if name in outcomes]
        assert window.rate(name) == (sum(met) / len(met) if met else None)
    for reason in "xyz":
        assert window.share(reason) == sum(r == reason for _, _, r in kept) / max(len(kept), 1)
