"""Agreement of poses with depth images of exactly known boxes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.detection import DepthAgreement, DepthAgreementConfig, DepthImage, depth_agreement, depth_buffer
from kmn_jax.geometry import Intrinsics, transform_points
from kmn_jax.simulate import Surfels
from tests.reference.meshes import pose, random_rotations

CAMERA = Intrinsics(*(jnp.float32(value) for value in (200.0, 200.0, 80.0, 60.0, 160, 120)))
SHAPE = (120, 160)
CONFIG = DepthAgreementConfig()
check = jax.jit(depth_agreement, static_argnames="config")


def cube(count: int, seed: int) -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(seed)
    axis, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), axis] = 0.5 * sign
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = sign
    return jnp.asarray(points, "f4"), jnp.asarray(normals, "f4")


TRUE = pose((0.1, -0.05, 5.0), random_rotations(1, 3)[0]).astype(np.float32)
SURFELS = Surfels(*cube(2048, 0), jnp.float32(6.0))
DIAMETER = jnp.float32(3**0.5)


@pytest.fixture(scope="module")
def depth() -> jax.Array:
    """The image of a cube alone."""
    points = transform_points(jnp.asarray(TRUE), cube(200_000, 1)[0])
    return depth_buffer(points, jnp.ones(len(points), dtype=bool), CAMERA, SHAPE)


def moved(x: float, y: float, z: float) -> jax.Array:
    return jnp.asarray(TRUE).at[:3, 3].add(jnp.array([x, y, z], dtype=jnp.float32))


def of(T: jax.Array, depth: jax.Array) -> DepthAgreement:
    found: DepthAgreement = check(T, SURFELS, DepthImage(depth, CAMERA), DIAMETER, config=CONFIG)
    np.testing.assert_allclose(sum(found), 1, atol=1e-5)
    return found


def test_a_buffer_keeps_the_nearest_point_of_each_pixel() -> None:
    points = jnp.array([[0, 0, 2.0], [0, 0, 1.0], [0.3, 0.2, 1.0], [0, 0, -1.0], [9.0, 0, 1.0], [0, 0, 0.5]])
    mask = jnp.array([True, True, True, True, True, False])
    found = depth_buffer(points, mask, CAMERA, SHAPE)
    assert found[60, 80] == 1
    assert found[100, 140] == 1
    assert int((found > 0).sum()) == 2


def test_the_true_pose_is_explained(depth: jax.Array) -> None:
    found = of(jnp.asarray(TRUE), depth)
    assert found.explained > 0.97


def test_a_pose_in_front_is_seen_through_and_one_behind_is_hidden(depth: jax.Array) -> None:
    assert of(moved(0, 0, -0.5), depth).violated > 0.9
    assert of(moved(0, 0, 0.5), depth).occluded > 0.8


def test_what_was_not_measured_speaks_neither_for_nor_against(depth: jax.Array) -> None:
    half = depth.at[:, 84:].set(0)
    found = of(jnp.asarray(TRUE), half)
    assert found.unknown > 0.2
    assert found.explained + found.unknown > 0.95
    assert of(moved(2, 0, 0), depth).unknown > 0.9
    assert of(jnp.asarray(TRUE), jnp.zeros(SHAPE)).unknown == pytest.approx(1)


def test_a_wall_behind_contradicts_a_pose_in_the_air(depth: jax.Array) -> None:
    wall = jnp.where(depth > 0, depth, 6.0)
    found = of(moved(1.5, 0, 0), wall)
    assert found.violated > 0.8


def test_behind_the_camera_nothing_is_known(depth: jax.Array) -> None:
    found = check(moved(0, 0, -10), SURFELS, DepthImage(depth, CAMERA), DIAMETER, config=CONFIG)
    assert [float(part) for part in found] == [0, 0, 0, 0, 0]
