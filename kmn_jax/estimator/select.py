"""Which hypotheses stand together: one pose an instance, and no two parts in one place."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kmn_jax.data.symmetry import Symmetries, rotation_about
from kmn_jax.geometry import nearest, transform_points
from kmn_jax.geometry.se3 import inverse
from kmn_jax.typing import Normals, Points, Scalar

_TURNS = 36  # of a continuous symmetry: 10 degrees, under which poses count as the same anyway


@dataclass(frozen=True)
class SelectConfig:
    """Set the selection; lengths are shares of the object's diameter."""

    same_pose: float = 0.2  # poses whose surfaces are nowhere further apart are one
    depth: float = 0.05  # a point so far below another part's surface is inside of it
    inside_share: float = 0.1  # of a part's points that may be inside of an accepted part
    num_points: int = 256  # on the surface, that are compared


def symmetry_transforms(symmetries: Symmetries) -> Float[np.ndarray, "t 4 4"]:
    """Return all poses `T_object_object` under which the object looks the same, continuous ones in steps."""
    center, rotations = symmetries.center, symmetries.rotations
    for axis in symmetries.axes:
        turns = np.stack([rotation_about(axis, 2 * np.pi * step / _TURNS) for step in range(_TURNS)])
        rotations = np.einsum("tij,sjk->tsik", turns, rotations).reshape(-1, 3, 3)
    result = np.tile(np.eye(4), (len(rotations), 1, 1))
    result[:, :3, :3] = rotations
    result[:, :3, 3] = center - rotations @ center
    return result.astype(np.float32)


def pose_distances(
    poses: Float[Array, "s 4 4"], points: Points, symmetries: Float[Array, "t 4 4"]
) -> Float[Array, "s s"]:
    """Return how far apart two poses hold a surface point at most, under the best symmetry (MSSD), for all pairs."""
    placed = jax.vmap(lambda pose: transform_points(pose, points))(poses)
    turned = jax.vmap(lambda symmetry: transform_points(symmetry, points))(symmetries)

    def to_all(pose: Float[Array, "4 4"]) -> Float[Array, " s"]:
        forms = jax.vmap(lambda form: transform_points(pose, form))(turned)

        def least(form: Points) -> Float[Array, " s"]:
            return ((form[None] - placed) ** 2).sum(axis=2).max(axis=1)

        return jnp.sqrt(jax.lax.map(least, forms).min(axis=0))

    return jax.lax.map(to_all, poses)


def inside_shares(poses: Float[Array, "s 4 4"], points: Points, normals: Normals, depth: Scalar) -> Float[Array, "s s"]:
    """Return which share of the points of each part (row) is deeper than `depth` inside of each other (column)."""

    def of(pose: Float[Array, "4 4"]) -> Float[Array, " s"]:
        placed = transform_points(pose, points)

        def within(other: Float[Array, "4 4"]) -> Scalar:
            seen = transform_points(inverse(other), placed)
            row, _ = nearest(seen, points)
            below = ((seen - points[row]) * normals[row]).sum(axis=1)
            return (below < -depth).mean()

        return jax.lax.map(within, poses)

    return jax.lax.map(of, poses)


def accept(score: Float[Array, " s"], usable: Bool[Array, " s"], excluded: Bool[Array, "s s"]) -> Bool[Array, " s"]:
    """Take hypotheses from the best score on, each unless one that was taken before excludes it.

    Equal scores go by their order. `excluded` holds for a pair in either order.
    """
    excluded = excluded | excluded.T
    order = jnp.argsort(-jnp.where(usable, score, -jnp.inf), stable=True)

    def step(taken: Bool[Array, " s"], row: Array) -> tuple[Bool[Array, " s"], None]:
        free = usable[row] & ~(excluded[row] & taken).any()
        return taken.at[row].set(free), None

    return jax.lax.scan(step, jnp.zeros_like(usable), order)[0]


def select(
    poses: Float[Array, "s 4 4"],
    score: Float[Array, " s"],
    usable: Bool[Array, " s"],
    points: Points,
    normals: Normals,
    symmetries: Float[Array, "t 4 4"],
    diameter: Scalar,
    config: SelectConfig,
) -> Bool[Array, " s"]:
    """Return which hypotheses to keep."""
    points, normals = points[: config.num_points], normals[: config.num_points]
    same = pose_distances(poses, points, symmetries) <= config.same_pose * diameter
    inside = inside_shares(poses, points, normals, config.depth * diameter) > config.inside_share
    return accept(score, usable, (same | inside) & ~jnp.eye(len(score), dtype=bool))
