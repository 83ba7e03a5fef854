"""Tickets for training trials."""

from hypothesis import given
from hypothesis import strategies as st

from crkr.sim_worker.supervisor.quota import Quota

STEPS = st.lists(st.sampled_from(["grant", "store", "lose", "store and lose", "poll"]), max_size=150)


@given(total=st.integers(0, 60), stored=st.integers(0, 60), steps=STEPS)
def test_one_supervisor_meets_the_total_exactly_whatever_is_lost_on_the_way(
    total: int, stored: int, steps: list[str]
) -> None:
    quota = Quota(total, stored)
    log, under_way = stored, 0
    for step in [*steps, *["grant", "store"] * 200]:  # in the end nothing more is lost
        if step == "grant":
            under_way += quota.grant(2)
        elif step == "poll":
            quota.observe(log)
        elif under_way:
            under_way -= 1
            log += step.startswith("store")
            if step == "store":
                quota.done()
        assert log + under_way <= max(total, stored)
        if quota.left == 0 and not under_way:
            quota.settle(log)
        assert quota.trained <= log
    assert log == max(total, stored)


OTHERS = st.lists(st.sampled_from(["grant", "store", "told", "lose", "outside"]), max_size=150)


@given(total=st.integers(0, 60), steps=OTHERS)
def test_trials_that_others_report_before_the_last_ticket_are_within_the_total(total: int, steps: list[str]) -> None:
    quota = Quota(total, 0)
    log, under_way, untold = 0, 0, 0
    for step in [*steps, *["grant", "store", "told"] * 200]:
        if step == "grant":
            quota.observe(log)
            granted = quota.grant(2)
            under_way += granted
            assert not granted or log + under_way <= total
        elif step == "outside" and log + under_way < total:
            log += 1
        elif step == "store" and under_way:
            under_way, untold, log = under_way - 1, untold + 1, log + 1
        elif step == "told" and untold:
            untold -= 1
            quota.done()
        elif step == "lose":
            under_way = max(0, under_way - 1)
        assert quota.trained <= log
        if quota.left == 0 and not under_way and not untold:
            quota.settle(log)
    assert log == total


def test_what_was_not_told_of_yet_is_granted_at_the_next_look() -> None:
    quota = Quota(10, 0)
    assert quota.grant(2) == 2
    quota.observe(7)  # at most two of these can be ours, and perhaps none is
    assert quota.left == 1
    quota.done()
    quota.done()
    quota.observe(7)
    assert quota.left == 3


def test_without_a_total_there_is_always_one_more() -> None:
    quota = Quota(None, 5)
    assert quota.left is None
    assert quota.grant(3) == 3
