import numpy as np
import pytest

from crkr.dashboard.rerun_view.world_layout import eye, facing, offset

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
    ends = np.array([offset(index, LOW, HIGH) for index in range(count)])
    low, high = LOW + ends.min(axis=0), HIGH + ends.max(axis=0)
    assert (position[:2] > high[:2]).any() or (position[:2] < low[:2]).any()
    assert (target >= low).all()
    assert (target <= high).all()


@pytest.mark.parametrize("position", [(3.0, -2.0, 4.0), (-1.0, 5.0, 0.5), (2.0, 2.0, -3.0)])
def test_a_camera_faces_its_target_and_stands_upright(position: tuple[float, float, float]) -> None:
    target = np.array([0.5, 0.25, 0.7])
    turn = facing(np.array(position), target)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    right, down, _ = turn.T
    assert right[2] == pytest.approx(0.0)
    assert down[2] < 0
    ahead = turn.T @ (target - position)
    np.testing.assert_allclose(ahead, np.array([0.0, 0.0, float(np.linalg.norm(target - position))]), atol=1e-12)
