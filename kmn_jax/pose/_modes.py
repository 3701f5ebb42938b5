"""The poses that differ among scored hypotheses, each refitted to its inliers under a shrinking gate.

On CPUs one pose after the other is refitted. On accelerators, where a small kernel takes as long to start as a large
one to run, all hypotheses are, at once: their inliers' sums are one matrix product.
"""

from __future__ import annotations

from functools import partial
from math import cos, radians
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.geometry import from_rotation_translation
from kmn_jax.platforms import by_platform
from kmn_jax.pose._kabsch import best_rotation, fit_rigid, rotation_is_determined, spread_is_determined
from kmn_jax.typing import Mask, Normals, Points, Pose, Scalar

# Poses that differ by more, in rotation or by so many diameters, are another mode.
_MODE_DEGREES = 30.0
_MODE_DISTANCE = 0.15

_LEAST_TRACE = 1e-5  # squared diameters that inliers' points spread: less is rounding of sums about another centre


class Pairs(NamedTuple):
    """Matches as RANSAC compares them: points about the usable ones' means, in diameters, zero where not usable."""

    object_points: Points
    scene_points: Points
    object_normals: Normals
    scene_normals: Normals
    weights: Float[Array, " n"]
    usable: Mask
    min_cosine: Scalar | None  # between normals of an inlier; None: normals play no part

    def inliers(self, pose: Pose, gate: Scalar | float) -> tuple[Mask, Float[Array, " n"]]:
        """Return which matches agree with a pose, and the squared distances: under vmap it stays one fused loop."""
        squares, cosines = jnp.float32(0), jnp.float32(0)
        for row in range(3):
            r0, r1, r2, shift = pose[row, 0], pose[row, 1], pose[row, 2], pose[row, 3]
            x, y, z = self.object_points[:, 0], self.object_points[:, 1], self.object_points[:, 2]
            squares = squares + (r0 * x + r1 * y + r2 * z + shift - self.scene_points[:, row]) ** 2
            x, y, z = self.object_normals[:, 0], self.object_normals[:, 1], self.object_normals[:, 2]
            cosines = cosines + (r0 * x + r1 * y + r2 * z) * self.scene_normals[:, row]
        agree = self.usable & (squares <= gate * gate)
        return (agree if self.min_cosine is None else agree & (cosines >= self.min_cosine)), squares


def refined_modes(
    poses: Float[Array, "h 4 4"], scores: Int[Array, " h"], pairs: Pairs, gates: Float[Array, " r"], count: int
) -> tuple[Float[Array, "m 4 4"], Bool[Array, " m"]]:
    """Return `count` refitted poses that differ, best first, and which of them there are; scores below 0 are none."""
    return by_platform(
        poses, scores, pairs, gates, cpu=partial(_in_turn, count=count), default=partial(_at_once, count=count)
    )


def _in_turn(
    poses: Float[Array, "h 4 4"], scores: Int[Array, " h"], pairs: Pairs, gates: Float[Array, " r"], count: int
) -> tuple[Float[Array, "m 4 4"], Bool[Array, " m"]]:
    def refine(pose: Pose, gate: Scalar) -> tuple[Pose, None]:
        weights = jnp.where(pairs.inliers(pose, gate)[0], pairs.weights, 0)
        refined = fit_rigid(pairs.object_points, pairs.scene_points, weights)
        # Kabsch always answers; with inliers on a line, or none, the answer would be arbitrary.
        return jnp.where(rotation_is_determined(pairs.object_points, weights), refined, pose), None

    def next_mode(left: Int[Array, " h"], _: None) -> tuple[Int[Array, " h"], tuple[Pose, Bool[Array, ""]]]:
        row = jnp.argmax(left)
        mode, _ = jax.lax.scan(refine, poses[row], gates)
        return jnp.where(_differ(poses, mode), left, -1), (mode, left[row] >= 0)

    return jax.lax.scan(next_mode, scores, length=count)[1]


def _at_once(
    poses: Float[Array, "h 4 4"], scores: Int[Array, " h"], pairs: Pairs, gates: Float[Array, " r"], count: int
) -> tuple[Float[Array, "m 4 4"], Bool[Array, " m"]]:
    """Return the same, up to rounding, by refitting all hypotheses before it is known which are the best."""
    p, q = pairs.object_points, pairs.scene_points
    products = [(q[:, :, None] * p[:, None, :]).reshape(-1, 9), (p[:, :, None] * p[:, None, :]).reshape(-1, 9)]
    terms = pairs.weights[:, None] * jnp.concatenate([jnp.ones((len(p), 1), p.dtype), p, q, *products], axis=1)

    def refit(poses: Float[Array, "h 4 4"], gate: Scalar) -> tuple[Float[Array, "h 4 4"], None]:
        inside = jax.vmap(lambda pose: pairs.inliers(pose, gate)[0])(poses).astype(jnp.float32)
        sums = jnp.matmul(inside, terms, precision=jax.lax.Precision.HIGHEST)
        return jax.vmap(_refitted)(poses, sums), None

    refined, _ = jax.lax.scan(refit, poses, gates)
    left, modes, there = scores, [], []
    for _ in range(count):
        row = jnp.argmax(left)
        modes.append(refined[row])
        there.append(left[row] >= 0)
        left = jnp.where(_differ(poses, refined[row]), left, -1)
    return jnp.stack(modes), jnp.stack(there)


def _refitted(pose: Pose, sums: Float[Array, " t"]) -> Pose:
    """Return the best pose of inliers, given the weighted sums of 1, p, q, q p^T and p p^T over them."""
    total = jnp.where(sums[0] > 0, sums[0], 1)
    means = sums[1:] / total
    object_centre, scene_centre = means[:3], means[3:6]
    covariance = means[6:15].reshape(3, 3) - scene_centre[:, None] * object_centre[None, :]
    scatter = means[15:24].reshape(3, 3) - object_centre[:, None] * object_centre[None, :]
    rotation = best_rotation(covariance)
    refitted = from_rotation_translation(rotation, scene_centre - (rotation * object_centre[None, :]).sum(axis=1))
    determined = (sums[0] > 0) & (jnp.trace(scatter) > _LEAST_TRACE) & spread_is_determined(scatter)
    return jnp.where(determined, refitted, pose)


def _differ(poses: Float[Array, "h 4 4"], pose: Pose) -> Bool[Array, " h"]:
    """Return which poses of centred points, in diameters, are another mode than the given one."""
    trace = (poses[:, :3, :3] * pose[None, :3, :3]).sum(axis=(1, 2))
    turned = trace < 1 + 2 * cos(radians(_MODE_DEGREES))
    moved = ((poses[:, :3, 3] - pose[None, :3, 3]) ** 2).sum(axis=1) > _MODE_DISTANCE**2
    return turned | moved
