"""A box on a floor, in it, in a pit and on a tower: what lies around it, half a diameter beyond its picture."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import DepthImage, Surroundings, surroundings
from kmn_jax.geometry import intrinsics
from kmn_jax.simulate import Surfels
from tests.detection.box_sample import CAMERA, SIZES, WALL, box_part
from tests.reference.meshes import pose

PART = box_part()
SURFELS = Surfels(jnp.asarray(PART.points), jnp.asarray(PART.normals), jnp.float32(PART.area))
HEIGHT = SIZES[2] / PART.diameter
LYING, FLUSH = (pose((0.0, 0.0, WALL + side * SIZES[2] / 2)) for side in (-1, 1))
compare = jax.jit(surroundings)


def of(T: np.ndarray, depth: jax.Array | np.ndarray) -> Surroundings:
    image = DepthImage(jnp.asarray(depth, dtype=jnp.float32), intrinsics(CAMERA))
    found: Surroundings = compare(jnp.asarray(T, dtype=jnp.float32), SURFELS, image, jnp.float32(PART.diameter))
    assert np.isfinite(np.array(found)).all()
    for name in ("unknown", "in_front", "behind", "far_behind", "buried"):
        assert 0 <= getattr(found, f"around_{name}") <= 1 + 1e-6, name
    return found


def everywhere(depth: float) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), depth)


def test_a_box_on_a_floor_is_above_it_and_one_in_it_is_buried() -> None:
    above, below = of(LYING, everywhere(WALL)), of(FLUSH, everywhere(WALL))
    assert above.around_buried < 0.01
    assert below.around_buried > 0.6  # all but the front and the upper edges of the sides
    np.testing.assert_allclose([above.around_lowest, above.around_highest], [0, HEIGHT], atol=0.01)
    np.testing.assert_allclose([below.around_lowest, below.around_highest], [-HEIGHT, 0], atol=0.01)
    np.testing.assert_allclose([above.around_raised, below.around_raised], [HEIGHT / 2, -HEIGHT / 2], atol=0.03)
    for found in (above, below):
        assert found.around_uneven < 0.005
        assert (found.around_unknown, found.around_in_front, found.around_behind) == (0, 0, 0)


@pytest.mark.parametrize("tilt", [(0.4, -0.2), (-0.3, 0.5)])
def test_a_box_lies_on_a_tilted_floor_as_on_one_across(tilt: tuple[float, float]) -> None:
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy
    down = np.array([-tilt[0], -tilt[1], 1.0]) / np.linalg.norm([*tilt, 1.0])
    along = np.cross([0.0, 1.0, 0.0], down)
    along /= np.linalg.norm(along)
    T = np.eye(4)
    T[:3, :3] = np.stack([along, np.cross(down, along), down], axis=1)
    T[:3, 3] = np.array([0.0, 0.0, WALL]) - SIZES[2] / 2 * down
    found = of(T, WALL / (1 - tilt[0] * x - tilt[1] * y))
    assert found.around_uneven < 0.005
    assert found.around_buried < 0.05
    assert found.around_lowest == pytest.approx(0, abs=0.01)
    # Heights are along the camera's axis, where lines of sight meet the floor: more so where these are aslant.
    assert 0.95 < found.around_highest * down[2] / HEIGHT < 1.25


def test_a_pit_is_in_front_and_a_tower_has_nothing_beside_it() -> None:
    pit, beside = of(LYING, everywhere(WALL - 2 * SIZES[2])), of(LYING, everywhere(WALL + 0.1 * PART.diameter))
    assert (pit.around_in_front, pit.around_behind) == (1, 0)
    assert pit.around_buried == 1
    assert (beside.around_behind, beside.around_far_behind) == (1, 0)
    tower = of(LYING, everywhere(WALL + 2 * PART.diameter))
    assert (tower.around_far_behind, tower.around_buried, tower.around_raised, tower.around_uneven) == (1, 0, 0, 0)


def test_what_was_not_measured_is_unknown_and_buries_nothing() -> None:
    found = of(LYING, everywhere(0.0))
    assert found.around_unknown == 1
    np.testing.assert_array_equal(np.delete(np.array(found), 0), 0)


def test_outside_of_the_image_and_around_the_camera_nothing_lies() -> None:
    for T in (pose((30.0, 0.0, 3.0)), pose((0.0, 0.0, -3.0)), pose((0.0, 0.0, 0.01))):
        for depth in (0.0, WALL):
            np.testing.assert_array_equal(np.array(of(T, everywhere(depth))), 0)
    far = of(pose((0.0, 0.0, 1e4 * PART.diameter)), everywhere(WALL))  # less than a pixel, behind a wall
    assert (far.around_in_front, far.around_buried) == (1, 0)
    whole = of(LYING, everywhere(WALL))
    border = (CAMERA.width - 1 - CAMERA.cx) / CAMERA.fx * WALL  # where half of the box is outside
    half = of(LYING @ pose((border, 0.0, 0.0)), everywhere(WALL))
    assert half.around_unknown == 0
    np.testing.assert_allclose(half.around_highest, whole.around_highest, atol=0.01)


def test_one_point_of_a_surface_is_enough() -> None:
    image = DepthImage(jnp.full((CAMERA.height, CAMERA.width), WALL), intrinsics(CAMERA))
    one = Surfels(SURFELS.points[:1], SURFELS.normals[:1], SURFELS.area)
    found = compare(jnp.asarray(LYING, dtype=jnp.float32), one, image, jnp.float32(PART.diameter))
    assert np.isfinite(np.array(found)).all()


@pytest.mark.parametrize("side", [-1, 1])
def test_half_of_a_floor_that_is_a_step_higher_is_uneven(side: int) -> None:
    left = (np.arange(CAMERA.width) - CAMERA.cx) * side < 0
    found = of(LYING, np.where(left[None], everywhere(WALL), WALL - 0.4 * PART.diameter))
    assert found.around_in_front == pytest.approx(0.5, abs=0.1)
    assert found.around_uneven > 0.05
    assert 0 < found.around_buried < 1


def test_what_lies_beyond_half_a_diameter_does_not_count() -> None:
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = (columns - CAMERA.cx) / CAMERA.fx * WALL, (rows - CAMERA.cy) / CAMERA.fy * WALL
    reach = (max(SIZES[:2]) / 2 + 0.5 * PART.diameter) * WALL / (WALL - SIZES[2])  # of the front, which is nearer
    away, near = np.maximum(abs(x), abs(y)) / reach, of(LYING, everywhere(WALL))
    np.testing.assert_array_equal(near, of(LYING, np.where(away > 1.05, 0.5 * WALL, WALL)))
    assert near.around_in_front == 0 < of(LYING, np.where(away > 0.9, 0.5 * WALL, WALL)).around_in_front
