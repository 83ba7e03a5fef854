import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.dashboard.window import Window

trials = st.tuples(
    st.none() | st.floats(0, 1), st.dictionaries(st.sampled_from("ab"), st.booleans()), st.sampled_from("xyz")
)


@given(st.lists(trials, max_size=40), st.integers(1, 10))
def test_a_window_says_what_counting_its_trials_anew_says(
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
