import numpy as np
import pytest

from crkr.dashboard.rerun_view.places import eye, offset

LOW, HIGH = np.array([-2.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.5])


def test_no_two_worlds_overlap() -> None:
    places = np.array([offset(index, LOW, HIGH) for index in range(12)])
    for index, place in enumerate(places):
        apart = np.abs(np.delete(places, index, axis=0) - place)
        assert ((apart[:, 0] >= 3.0) | (apart[:, 1] >= 2.0)).all()


def test_the_first_world_stays_where_it_is() -> None:
    np.testing.assert_array_equal(offset(0, LOW, HIGH), np.zeros(3))


@pytest.mark.parametrize("count", [1, 2, 4, 9])
def test_the_eye_is_above_and_outside_of_the_worlds(count: int) -> None:
    position, target = eye(count, LOW, HIGH)
    assert position[2] > HIGH[2]
    last = offset(min(count, 4) - 1, LOW, HIGH)
    assert (position[:2] > (HIGH + last)[:2]).any() or (position[:2] < LOW[:2]).any()
    assert (target >= LOW).all()
    assert (target <= HIGH + last).all()
