import math

from hypothesis import given
from hypothesis import strategies as st

from crkr.dashboard.wilson import wilson_interval

counts = st.integers(1, 10_000).flatmap(lambda count: st.tuples(st.integers(0, count), st.just(count)))


@given(counts)
def test_the_interval_ends_where_the_rate_is_z_standard_errors_away(numbers: tuple[int, int]) -> None:
    successes, count = numbers
    rate = successes / count
    for end in wilson_interval(successes, count, z=2.0):
        if 0 < end < 1:  # at 0 and 1 the definition holds trivially, rounding aside
            assert math.isclose((end - rate) ** 2, 4.0 * end * (1 - end) / count, rel_tol=1e-6, abs_tol=1e-12)


@given(counts)
def test_the_interval_holds_the_rate_and_stays_within_zero_and_one(numbers: tuple[int, int]) -> None:
    low, high = wilson_interval(*numbers)
    assert 0 <= low <= numbers[0] / numbers[1] + 1e-12
    assert numbers[0] / numbers[1] - 1e-12 <= high <= 1


def test_nothing_observed_says_nothing() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
