"""Tickets for training trials."""

from hypothesis import given
from hypothesis import strategies as st

from crkr.sim_worker.quota import Quota


@given(total=st.integers(0, 60), stored=st.integers(0, 60), data=st.data())
def test_one_launcher_meets_the_total_exactly_whatever_is_lost_on_the_way(
    total: int, stored: int, data: st.DataObject
) -> None:
    quota = Quota(total, stored)
    log, under_way = stored, 0
    for _ in range(1000):
        action = data.draw(st.sampled_from(["grant", "store", "lose", "store and lose", "poll"]))
        if action == "grant":
            under_way += quota.grant(data.draw(st.integers(0, 5)))
        elif action == "poll":
            quota.observe(log)
        elif under_way:
            under_way -= 1
            log += action.startswith("store")
            if action == "store":
                quota.done()
        if quota.left == 0 and not under_way:
            quota.settle(log)
            if quota.left == 0:
                break
        assert quota.trained <= log
    else:
        while quota.left:  # the draw of actions was unlucky: no more losses
            for _ in range(under_way + quota.grant(5)):
                log += 1
                quota.done()
            under_way = 0
            if quota.left == 0:
                quota.settle(log)
    assert log == max(total, stored) or under_way


def test_trials_of_other_launchers_use_up_the_total_too() -> None:
    quota = Quota(10, 0)
    assert quota.grant(2) == 2
    quota.observe(7)  # at most two of these can be ours
    assert quota.left == 3


def test_without_a_total_there_is_always_one_more() -> None:
    quota = Quota(None, 5)
    assert quota.left is None
    assert quota.grant(3) == 3
