import numpy as np
import pytest

from crkr.dashboard.page.markup import html
from crkr.dashboard.page.regions import ordered, pairs, slice_chart, state_map, worst_region
from crkr.protocol import StateDimension

AXES = (
    StateDimension("x", "m", -1.0, 1.0, 0.5),
    StateDimension("speed", "m/s", 0.0, 4.0, 1.0),
    StateDimension("fixed", "", 0.0, 1.0, 0.2),
)


def drawn(count: int) -> np.ndarray:
    rng = np.random.default_rng(2)
    return np.column_stack([rng.uniform(-1, 1, count), rng.uniform(0, 4, count), np.full(count, 0.5)])


def test_a_planted_weakness_is_named() -> None:
    states = drawn(1000)
    region = worst_region(AXES, states, states[:, 1] < 3.0)
    assert region is not None
    assert (region.axis.name, region.low, region.high) == ("speed", 3.0, None)
    assert (region.inside, region.elsewhere) == (0.0, 1.0)
    assert str(region).startswith("It fails most where speed is above 3 m/s: 0\u202f% of ")


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_chance_is_no_weakness(share: float) -> None:
    flags = np.random.default_rng(3).uniform(size=2000) < share
    assert worst_region(AXES, drawn(2000), flags) is None


def test_the_telling_coordinate_comes_first_and_a_constant_one_is_left_out() -> None:
    states = drawn(500)
    order = ordered(AXES, states, states[:, 1] < 2.0)
    assert order == [1, 0]
    assert pairs(order) == [(1, 0)]


def test_a_map_shows_each_cell_with_its_counts() -> None:
    states = np.array([[-0.95, 0.1]] * 3 + [[0.95, 3.9]] * 2 + [[9.0, 9.0]])
    text = html(state_map((AXES[0], AXES[1]), states[:, :2], np.array([1, 1, 0, 1, 1, 1], dtype=bool)))
    assert text.count('class="cell') == 2
    assert "67\u202f% of 3 succeed" in text
    assert "100\u202f% of 3 succeed" in text  # what lies outside counts at the edge


def test_a_slice_has_a_range_for_each_part_with_trials() -> None:
    text = html(slice_chart(AXES[1], np.array([0.1, 0.2, 3.9]), np.array([True, False, True])))
    assert text.count('class="range"') == 2
    assert "50\u202f% of 2 succeed" in text
