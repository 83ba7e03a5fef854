import numpy as np
import pytest

from crkr.dashboard.rerun_view.shapes import bounds, shapes_by_body
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
