"""Selection of hypotheses: distances under symmetries, parts inside of parts, and the greedy choice."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kmn_jax.data.symmetry import Symmetries, rotation_about
from kmn_jax.estimator.select import (
    SelectConfig,
    accept,
    inside_shares,
    pose_distances,
    select,
    symmetry_transforms,
)
from tests.reference.meshes import pose, random_rotations

Z = np.array([0.0, 0.0, 1.0])


def box(count: int = 256, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    """Return points and normals on a box of 2 x 1 x 1 about the origin."""
    rng = np.random.default_rng(seed)
    half = np.array([1.0, 0.5, 0.5])
    axis, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points = rng.uniform(-1, 1, (count, 3)) * half
    points[np.arange(count), axis] = sign * half[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = sign
    return jnp.asarray(points, "f4"), jnp.asarray(normals, "f4")


def poses(*transforms: np.ndarray) -> jax.Array:
    return jnp.asarray(np.stack(transforms), "f4")


def test_distances_are_those_of_the_farthest_point() -> None:
    points, _ = box()
    shift = np.eye(4)
    shift[:3, 3] = [0.3, 0.4, 0]
    turn = np.eye(4)
    turn[:3, :3] = rotation_about(Z, np.pi / 2)
    found = pose_distances(poses(np.eye(4), shift, turn), points, jnp.eye(4)[None])
    np.testing.assert_allclose(np.diag(found), 0, atol=1e-5)
    np.testing.assert_allclose(found[0, 1], 0.5, rtol=1e-5)
    farthest = np.linalg.norm(np.asarray(points) - points @ turn[:3, :3].T, axis=1).max()
    np.testing.assert_allclose([found[0, 2], found[2, 0]], farthest, rtol=1e-5)


def test_symmetric_poses_are_the_same() -> None:
    points, _ = box()
    rotations = np.stack([np.eye(3), rotation_about(Z, np.pi)])
    transforms = jnp.asarray(symmetry_transforms(Symmetries(rotations, np.zeros((0, 3)), np.array([0.1, 0, 0]), 0.02)))
    base = pose((1.0, 2.0, 3.0), random_rotations(1, 0)[0])
    same = base @ np.asarray(transforms[1])
    found = pose_distances(poses(base, same, base @ pose((0, 0, 0), rotation_about(Z, 0.5))), points, transforms)
    np.testing.assert_allclose(found[0, 1], 0, atol=1e-4)
    assert found[0, 2] > 0.2
    np.testing.assert_allclose(
        np.asarray(transforms[1]) @ [0.1, 0, 0, 1], [0.1, 0, 0, 1], atol=1e-6
    )  # about the centre


def test_continuous_symmetries_are_taken_in_steps() -> None:
    symmetries = Symmetries(np.eye(3)[None], Z[None], np.zeros(3), 0.02)
    transforms = jnp.asarray(symmetry_transforms(symmetries))
    assert transforms.shape == (36, 4, 4)
    points = jnp.array([[1.0, 0, 0], [0, 1.0, 0.5]])
    turned = pose((0, 0, 0), rotation_about(Z, np.radians(95)))
    found = pose_distances(poses(np.eye(4), turned), points, transforms)
    np.testing.assert_allclose(found[0, 1], 2 * np.sin(np.radians(2.5)), rtol=1e-3)


def test_points_inside_of_another_part_are_counted() -> None:
    points, normals = box()
    apart, beside, through = np.eye(4), np.eye(4), np.eye(4)
    apart[:3, 3], beside[:3, 3], through[:3, 3] = [5, 0, 0], [0, 1.0, 0], [0, 0.4, 0]
    found = inside_shares(poses(np.eye(4), apart, beside, through), points, normals, jnp.float32(0.05))
    np.testing.assert_allclose(np.diag(found), 0)
    assert found[0, 1] == found[1, 0] == 0
    assert found[0, 2] < 0.05  # they touch, and points are few
    assert found[0, 3] > 0.1
    assert found[3, 0] > 0.1


def test_the_best_of_what_excludes_each_other_is_taken() -> None:
    score = jnp.array([0.5, 0.9, 0.8, 0.99, 0.4])
    usable = jnp.array([True, True, True, False, True])
    excluded = jnp.zeros((5, 5), dtype=bool).at[0, 1].set(True).at[2, 4].set(True).at[3, 1].set(True)
    np.testing.assert_array_equal(accept(score, usable, excluded), [False, True, True, False, False])
    np.testing.assert_array_equal(accept(score * 0, usable, excluded), [True, False, True, False, False])


@pytest.mark.parametrize("first", [0, 1])
def test_one_pose_an_instance_is_kept(first: int) -> None:
    points, normals = box()
    there = np.eye(4)
    there[:3, 3] = [0, 0, 3]
    near = there.copy()
    near[:3, 3] += [0.02, 0, 0.01]
    crossed = there @ pose((0, 0.1, 0.1), rotation_about(Z, np.pi / 2))
    elsewhere = np.eye(4)
    elsewhere[:3, 3] = [0, 1.2, 3]
    candidates = poses(there, near, crossed, elsewhere)
    score = jnp.array([0.9, 0.8, 0.7, 0.6]).at[first].set(0.95)
    kept = jax.jit(select, static_argnames="config")(
        candidates,
        score,
        jnp.ones(4, dtype=bool),
        points,
        normals,
        jnp.eye(4)[None],
        jnp.float32(6**0.5),
        config=SelectConfig(),
    )
    np.testing.assert_array_equal(kept, [first == 0, first == 1, False, True])
