import numpy as np
import pytest

from crkr.dashboard.rerun_view.scene import bounds, eye, offset, shapes_by_body, upright_rotation
from crkr.protocol import Geom

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
GREY = (0.5, 0.5, 0.5, 1.0)


def test_shapes_of_one_kind_on_one_body_become_one_entity(scene: tuple[Geom, ...]) -> None:
    found = {(body, kind): archetype for body, kind, archetype in shapes_by_body(scene)}
    assert set(found) == {("world", "box"), ("boom", "capsule"), ("boom", "cylinder"), ("hook", "sphere")}
    assert len(found["world", "box"].half_sizes.as_arrow_array()) == 2


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2, 2.5])
def test_a_capsule_starts_half_its_length_below_its_middle(angle: float) -> None:
    half, middle = 0.5, np.array([1.0, 2.0, 3.0])
    about_x = (float(np.sin(angle / 2)), 0.0, 0.0, float(np.cos(angle / 2)))
    capsule = Geom("arm", "capsule", (0.1, half, 0.0), tuple(middle), about_x, GREY)
    ((_, _, archetype),) = shapes_by_body([capsule])
    start = archetype.translations.as_arrow_array().to_pylist()[0]
    turned = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(start, middle - turned @ [0.0, 0.0, half], atol=1e-6)
    assert archetype.lengths.as_arrow_array().to_pylist() == [2 * half]


def test_a_cylinder_lies_around_its_middle_with_its_whole_length() -> None:
    cylinder = Geom("arm", "cylinder", (0.1, 0.5, 0.0), (1.0, 2.0, 3.0), UPRIGHT, GREY)
    ((_, _, archetype),) = shapes_by_body([cylinder])
    assert archetype.centers.as_arrow_array().to_pylist() == [[1.0, 2.0, 3.0]]
    assert archetype.lengths.as_arrow_array().to_pylist() == [1.0]


def test_the_floor_does_not_count_for_the_size_of_a_world(scene: tuple[Geom, ...]) -> None:
    low, high = bounds(scene)
    np.testing.assert_allclose(low, [-2.0, -1.0, -0.2])
    np.testing.assert_allclose(high, [2.0, 1.0, 0.0])


def test_a_world_of_moving_shapes_has_a_size_too(scene: tuple[Geom, ...]) -> None:
    low, high = bounds([geom for geom in scene if geom.body != "world"])
    assert (high > low).all()


LOW, HIGH = np.array([-2.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.5])


def test_no_two_worlds_overlap() -> None:
    places = np.array([offset(index, LOW, HIGH) for index in range(12)])
    for index, place in enumerate(places):
        apart = np.abs(np.delete(places, index, axis=0) - place)
        assert ((apart[:, 0] >= 3.0) | (apart[:, 1] >= 2.0)).all()


def test_the_first_world_stays_where_it_is() -> None:
    np.testing.assert_array_equal(offset(0, LOW, HIGH), np.zeros(3))


@pytest.mark.parametrize("count", [1, 2, 4, 9])
def test_the_camera_is_above_and_outside_of_the_worlds(count: int) -> None:
    position, target = eye(count, LOW, HIGH)
    assert position[2] > HIGH[2]
    ends = np.array([offset(index, LOW, HIGH) for index in range(count)])
    low, high = LOW + ends.min(axis=0), HIGH + ends.max(axis=0)
    assert (position[:2] > high[:2]).any() or (position[:2] < low[:2]).any()
    assert (target >= low).all()
    assert (target <= high).all()


@pytest.mark.parametrize("position", [(3.0, -2.0, 4.0), (-1.0, 5.0, 0.5), (2.0, 2.0, -3.0)])
def test_a_camera_is_upright_and_faces_its_target(position: tuple[float, float, float]) -> None:
    target = np.array([0.5, 0.25, 0.7])
    turn = upright_rotation(np.array(position), target)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    right, down, _ = turn.T
    assert right[2] == pytest.approx(0.0)
    assert down[2] < 0
    ahead = turn.T @ (target - position)
    np.testing.assert_allclose(ahead, np.array([0.0, 0.0, float(np.linalg.norm(target - position))]), atol=1e-12)
