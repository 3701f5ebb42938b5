"""Rigid poses as 4x4 matrices, rotations and quaternions.

`T_target_source` maps points from the frame `source` into the frame `target`; translations are in the unit of
the points. Quaternions are ordered w, x, y, z. All of it is differentiable, with finite gradients everywhere.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kmn_jax.errors import check_shape
from kmn_jax.typing import Normals, Points, Pose, PRNGKey, Quaternion, Rotation, Scalar


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root, with gradient zero (rather than infinite) at zero."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_norm(vectors: Float[Array, "... d"]) -> Float[Array, "..."]:
    """Return the length of each vector, with gradient zero (rather than NaN) for the zero vector."""
    return safe_sqrt((vectors**2).sum(axis=-1))


def _product(a: Float[Array, "i j"], b: Float[Array, "j k"]) -> Float[Array, "i k"]:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)  # the default is bfloat16 or TF32 on accelerators


def compose(T_a_b: Pose, T_b_c: Pose) -> Pose:
    """Return `T_a_c`, the pose that applies `T_b_c` first and `T_a_b` after it."""
    return _product(T_a_b, T_b_c)


def inverse(T_target_source: Pose) -> Pose:
    """Return `T_source_target`, taking the rotation's transpose as its inverse."""
    rotation = T_target_source[:3, :3].T
    return from_rotation_translation(rotation, -_product(rotation, T_target_source[:3, 3:])[:, 0])


def transform_points(T_target_source: Pose, points: Points) -> Points:
    """Rotate and translate points from the source into the target frame. Raises InputError for other shapes."""
    check_shape(T_target_source, "T_target_source", (4, 4))
    check_shape(points, "points", (None, 3))
    return _product(points, T_target_source[:3, :3].T) + T_target_source[None, :3, 3]


def rotate_vectors(T_target_source: Pose, vectors: Normals) -> Normals:
    """Rotate directions, such as normals, from the source into the target frame. Raises InputError for other shapes."""
    check_shape(T_target_source, "T_target_source", (4, 4))
    check_shape(vectors, "vectors", (None, 3))
    return _product(vectors, T_target_source[:3, :3].T)


def from_rotation_translation(rotation: Rotation, translation: Float[Array, " 3"]) -> Pose:
    """Return the pose of a rotation matrix followed by a translation."""
    top = jnp.concatenate([rotation, translation[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], dtype=top.dtype)], axis=0)


def from_quaternion_translation(quaternion: Quaternion, translation: Float[Array, " 3"]) -> Pose:
    """Return the pose of a quaternion followed by a translation."""
    return from_rotation_translation(quaternion_to_matrix(quaternion), translation)


def quaternion_to_matrix(quaternion: Quaternion) -> Rotation:
    """Return the rotation matrix of a quaternion of any length; the zero quaternion gives the identity."""
    square = (quaternion**2).sum()
    w, x, y, z = quaternion * jnp.where(square > 0, jnp.sqrt(2 / jnp.where(square > 0, square, 1)), 0)
    return jnp.array(
        [
            [1 - y * y - z * z, x * y - w * z, x * z + w * y],
            [x * y + w * z, 1 - x * x - z * z, y * z - w * x],
            [x * z - w * y, y * z + w * x, 1 - x * x - y * y],
        ]
    )


def matrix_to_quaternion(rotation: Rotation) -> Quaternion:
    """Return the unit quaternion of a rotation matrix, with w >= 0.

    All entries of 4 q q^T are linear in the matrix, and its row with the largest diagonal entry is q times a
    factor of at least 1: no division by a small number at any angle.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    outer = jnp.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
        ]
    )
    row = outer[jnp.argmax(jnp.diagonal(outer))]
    quaternion = row / jnp.sqrt((row**2).sum())
    return jnp.where(quaternion[0] < 0, -quaternion, quaternion)


def rotation_angle_between(R_a: Rotation, R_b: Rotation) -> Scalar:
    """Return the geodesic distance of two rotations in radians, from 0 to pi.

    By way of the quaternion it is good to 1e-6 at all angles, where the arc cosine of the trace is off by up to
    1e-3 near 0 and pi. The gradient at equal rotations is zero.
    """
    quaternion = matrix_to_quaternion(_product(R_a.T, R_b))
    return 2 * jnp.arctan2(safe_norm(quaternion[1:]), quaternion[0])


def pose_error(T_a: Pose, T_b: Pose) -> tuple[Scalar, Scalar]:
    """Return the rotation error of two poses of the same object in radians, and the translation error."""
    return rotation_angle_between(T_a[:3, :3], T_b[:3, :3]), safe_norm(T_a[:3, 3] - T_b[:3, 3])


def random_rotation(key: PRNGKey) -> Rotation:
    """Draw a rotation matrix uniformly from all rotations."""
    return quaternion_to_matrix(jax.random.normal(key, (4,), jnp.float32))


def random_pose(key: PRNGKey, translation_scale: Scalar | float = 1.0) -> Pose:
    """Draw a pose with a uniform rotation and a normal translation, whose coordinates have this deviation."""
    rotation_key, translation_key = jax.random.split(key)
    drawn = jax.random.normal(translation_key, (3,), jnp.float32)
    return from_rotation_translation(random_rotation(rotation_key), jnp.float32(translation_scale) * drawn)
