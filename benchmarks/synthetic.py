"""Matches with a known pose: what tests and benchmarks of the pose solver share."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kmn_jax.geometry import from_rotation_translation, random_rotation, rotate_vectors, transform_points
from kmn_jax.pose import Matches
from kmn_jax.typing import Normals, Points, Pose, PRNGKey

SIDES = (0.8, 0.5, 0.33)  # of the box, in diameters: their root sum of squares is 1


def box_surface(key: PRNGKey, count: int, diameter: float = 1.0) -> tuple[Points, Normals]:
    """Draw points and outward normals, uniformly over the surface of a box centred on the origin."""
    face_key, sign_key, place_key = jax.random.split(key, 3)
    sides = jnp.array(SIDES) * (diameter / sum(side**2 for side in SIDES) ** 0.5)
    areas = jnp.prod(sides) / sides
    axis = jax.random.choice(face_key, 3, (count,), p=areas / areas.sum())
    sign = jax.random.rademacher(sign_key, (count,), dtype=jnp.float32)
    normals = jax.nn.one_hot(axis, 3, dtype=jnp.float32) * sign[:, None]
    inside = jax.random.uniform(place_key, (count, 3), minval=-0.5, maxval=0.5)
    points = jnp.where(normals != 0, normals / 2, inside) * sides[None, :]
    return points, normals


def synthetic_matches(
    key: PRNGKey,
    num_matches: int = 2048,
    inlier_share: float = 0.2,
    noise: float = 0.01,
    normal_noise: float = 0.1,
    diameter: float = 50.0,
) -> tuple[Matches, Pose]:
    """Draw matches of a box of which a share is right, and return them with the true T_scene_object.

    Right matches get Gaussian noise on the scene point (deviation `noise`, a fraction of the diameter) and on the
    normal (radians). Wrong ones pair a random object point with a random point and normal of the crop, a ball of
    one diameter about a point of the object. The object's frame has its origin at the object's centre, so that the
    pose's translation is that of the centre.
    """
    keys = jax.random.split(key, 9)
    points, normals = box_surface(keys[0], num_matches, diameter)
    rotation = random_rotation(keys[1])
    pose = from_rotation_translation(rotation, 10 * diameter * jax.random.normal(keys[2], (3,)))

    seed = transform_points(pose, points)[:1]
    direction = _unit(jax.random.normal(keys[3], (num_matches, 3)))
    radius = diameter * jax.random.uniform(keys[4], (num_matches, 1)) ** (1 / 3)
    wrong_points, wrong_normals = seed + radius * direction, _unit(jax.random.normal(keys[5], (num_matches, 3)))

    right_points = transform_points(pose, points) + noise * diameter * jax.random.normal(keys[6], (num_matches, 3))
    jitter = normal_noise * jax.random.normal(keys[7], (num_matches, 3))
    right_normals = _unit(rotate_vectors(pose, normals) + jitter)

    is_right = jnp.arange(num_matches) < round(inlier_share * num_matches)
    shuffle = jax.random.permutation(keys[8], num_matches)
    is_right = is_right[shuffle][:, None]
    matches = Matches(
        object_points=points,
        object_normals=normals,
        scene_points=jnp.where(is_right, right_points, wrong_points),
        scene_normals=jnp.where(is_right, right_normals, wrong_normals),
        weights=jnp.ones(num_matches),
        mask=jnp.ones(num_matches, dtype=bool),
        overflow=jnp.array(False),
        object_diameter=jnp.float32(diameter),
    )
    return matches, pose


def _unit(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return vectors / jnp.linalg.norm(vectors, axis=1, keepdims=True)
