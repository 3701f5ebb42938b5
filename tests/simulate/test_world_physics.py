"""Parts of several kinds at rest in containers of any shape."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.simulate import (
    Bin,
    BinConfig,
    BinScene,
    CameraConfig,
    CollisionShape,
    Container,
    Fixture,
    RayMesh,
    block_mesh,
    collision_shape,
    container_blocks,
    place_camera,
    render,
    rows_of,
    settle_in,
)
from tests.reference.meshes import box

CONFIG = BinConfig(penetration=0.01)
VERTICES, TRIANGLES = box(40.0, 20.0, 10.0)
VERTICES = VERTICES + np.array([20.0, 10, 5])  # millimetres, its corner at the origin


@pytest.fixture(scope="module")
def brick() -> CollisionShape:
    return collision_shape(VERTICES, TRIANGLES)


def container(height: float = 0.8, slope: float = 0.3) -> Container:
    values = ([1.4, 1.2], height, slope, 0.1, 0.05 if height else 0.0, [0, 0], [0, 0], 0.0, np.inf)
    return Container(*(jnp.asarray(value, dtype=jnp.float32) for value in values))


def corners(poses: np.ndarray) -> np.ndarray:
    return np.einsum("nij,vj->nvi", poses[:, :3, :3], VERTICES) + poses[:, None, :3, 3]


def test_parts_rest_within_leaning_walls_and_repeat(brick: CollisionShape) -> None:
    small = collision_shape(0.5 * VERTICES, TRIANGLES)
    shapes = [brick] * 4 + [small] * 3
    drop = settle_in(shapes, container(), CONFIG, 3)
    assert not drop.fault
    assert drop.inside.all()
    lowest = corners(drop.T_world_object)[:4, :, 2].min(axis=1)
    assert (lowest > -0.01 * brick.diagonal).all()
    assert (lowest < 0.05 * brick.diagonal).any()
    again = settle_in(shapes, container(), CONFIG, 3)
    np.testing.assert_array_equal(drop.T_world_object, again.T_world_object)


def test_what_falls_off_is_outside(brick: CollisionShape) -> None:
    start = np.tile(np.eye(4), (2, 1, 1))
    start[:, :3, 3] = [[0, 0, 1], [150, 0, 1]]  # the second one beside the bin
    drop = settle_in([brick, brick], container(), CONFIG, 0, start)
    assert drop.inside.tolist() == [True, False]


def test_too_small_a_container_is_told(brick: CollisionShape) -> None:
    tiny = container()._replace(half=jnp.full(2, 0.1))
    assert "too small" in settle_in([brick], tiny, CONFIG, 0).fault
    with pytest.raises(InputError, match="shapes is empty"):
        settle_in([], container(), CONFIG, 0)


def test_parts_of_rows_lie_side_by_side(brick: CollisionShape) -> None:
    starts, half = rows_of(brick, (2, 3), CONFIG, 1)
    covered = 2 * half * brick.diagonal / 1.005
    expected = min(([2 * 20, 3 * 40], [2 * 40, 3 * 20]), key=lambda size: abs(covered - size).max())
    np.testing.assert_allclose(covered, expected, rtol=0.05)
    drop = settle_in(
        [brick] * 6, container()._replace(half=jnp.asarray(half + 0.02, dtype=jnp.float32)), CONFIG, 0, starts
    )
    assert not drop.fault
    placed = corners(drop.T_world_object)
    assert drop.inside.all()
    np.testing.assert_allclose(np.ptp(placed[..., 2], axis=1), 10, atol=0.5)  # flat
    gaps = placed.min(axis=1)[:, None, :2] - placed.max(axis=1)[None, :, :2]
    apart = gaps.max(axis=2)[~np.eye(6, dtype=bool)].reshape(6, 5)
    assert (np.maximum(apart, apart.T.reshape(6, 5)).min(axis=1) < 2).all()


def test_fixtures_take_the_place_of_the_bin() -> None:
    bin = Bin(80.0, 60.0, 30.0, 2.0)
    camera, T_camera_bin = place_camera(bin, 45.0, CameraConfig(160, 120, tilt=0.0), np.random.default_rng(0))
    vertices, triangles = block_mesh([block * 45 for block in container_blocks(container(height=0.0))])
    pose = np.eye(4)
    pose[:3, 3] = [20, 0, 0]
    other = Fixture(VERTICES, TRIANGLES, pose[None])
    scene = BinScene(
        bin, np.eye(4)[None] * 1.0, camera, T_camera_bin, (Fixture(vertices, triangles, np.eye(4)[None]), other)
    )
    mesh = RayMesh(VERTICES, TRIANGLES)
    seen = render(mesh, scene)
    height = np.linalg.inv(T_camera_bin)[2, 3]
    assert set(np.unique(seen.instances)) == {0, 1}  # the copy, and all that is none
    assert np.isclose(seen.depth.max(), height, rtol=1e-3)  # the table is all around
    on_other = (seen.instances == 1) & np.isclose(seen.depth, height - 10, rtol=1e-4)
    assert on_other.sum() > 0.2 * (seen.instances == 0).sum()
    bare = render(mesh, BinScene(bin, np.eye(4)[None], camera, T_camera_bin))
    assert bare.depth.max() > seen.depth.max() or (bare.depth == 0).any()
