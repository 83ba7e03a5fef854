"""When epochs end."""

from hypothesis import given
from hypothesis import strategies as st

from crkr.sim_worker.evaluation.epoch_schedule import EpochClock


@given(st.lists(st.integers(0, 30), max_size=40))
def test_from_an_empty_task_each_epoch_is_named_once_and_in_order(steps: list[int]) -> None:
    clock, trained, named = EpochClock(0, ()), 0, []
    for step in steps:
        named += clock.ended(trained)
        trained += step
    named += clock.ended(trained)
    assert named == list(range(trained // 50 + 1))


def test_a_resumed_run_names_only_epochs_whose_model_is_still_there() -> None:
    clock = EpochClock(130, {0, 1})
    assert clock.ended(130) == [2]
    assert clock.ended(149) == []
    assert clock.ended(150) == [3]


def test_epochs_that_were_judged_before_are_not_named_again() -> None:
    assert EpochClock(100, {0, 1, 2}).ended(149) == []
