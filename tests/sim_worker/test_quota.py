"""Tickets for training trials."""

from hypothesis import given
from hypothesis import strategies as st

from crkr.sim_worker.quota import Quota

STEPS = st.lists(st.sampled_from(["grant", "store", "lose", "store and lose", "poll"]), max_size=150)


@given(total=st.integers(0, 60), stored=st.integers(0, 60), steps=STEPS)
def test_one_launcher_meets_the_total_exactly_whatever_is_lost_on_the_way(
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


def test_trials_of_other_launchers_use_up_the_total_too() -> None:
    quota = Quota(10, 0)
    assert quota.grant(2) == 2
    quota.observe(7)  # at most two of these can be ours
    assert quota.left == 3


def test_without_a_total_there_is_always_one_more() -> None:
    quota = Quota(None, 5)
    assert quota.left is None
    assert quota.grant(3) == 3
