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


def test_a_floor_may_be_tilted() -> None:
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy
    found = of(LYING, WALL / (1 - 0.4 * x + 0.2 * y))
    assert found.around_uneven < 0.01
    assert found.around_highest - found.around_lowest > 1.1 * HEIGHT  # the box is not parallel to it


def test_a_pit_is_in_front_and_a_tower_has_nothing_beside_it() -> None:
    pit, beside = of(LYING, everywhere(WALL - 2 * SIZES[2])), of(LYING, everywhere(WALL + 0.1 * PART.diameter))
    assert (pit.around_in_front, pit.around_behind) == (1, 0)
    assert pit.around_buried == 1
    assert (beside.around_behind, beside.around_far_behind) == (1, 0)
    tower = of(LYING, everywhere(WALL + 2 * PART.diameter))
    assert (tower.around_far_behind, tower.around_buried, tower.around_raised, tower.around_uneven) == (1, 0, 0, 0)


def test_what_was_not_measured_is_unknown_and_buries_nothing() -> None:
    for T in (LYING, pose((30.0, 0.0, 3.0)), pose((0.0, 0.0, -3.0))):
        found = of(T, everywhere(0.0))
        assert found.around_unknown == 1
        np.testing.assert_array_equal(np.delete(np.array(found), 0), 0)


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
    far = np.maximum(abs(x), abs(y)) > 1.05 * reach
    near, changed = of(LYING, everywhere(WALL)), of(LYING, np.where(far, 0.5 * WALL, WALL))
    np.testing.assert_array_equal(near, changed)
