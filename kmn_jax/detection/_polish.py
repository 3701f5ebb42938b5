"""The last step of a refined pose: all that the depth image says of the surface that the sensor sees.

Searches and refinements use few points, whose normals are estimated from noisy neighbours. Here every visible point of
the part is compared with what was measured in its direction, along the part's own normal, which is exact.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.detection._depth_agreement import DepthImage, measured_at
from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._mapping import call_rows
from kmn_jax.geometry import (
    compose,
    from_rotation_translation,
    rotate_vectors,
    smallest_at,
    spread_rows,
    transform_points,
)
from kmn_jax.pose import motion_between, plane_step, repeat_while, rotation_is_determined
from kmn_jax.programs import kept
from kmn_jax.simulate import SplatConfig, visible_by_splatting
from kmn_jax.typing import Pose, Scalar

_SIGHT = SplatConfig(resolution=64)  # of the part alone
_ROUNDS = 15
_STILL = 1e-4  # a smaller step, in radians and diameters, is the last one
_GATE = 0.05  # diameters, between a point of the part and what was measured in its direction
_SPREADS = 4  # medians of the distances, beyond which a measurement is of something else
_LEAST_SPREAD = 2.5e-3  # diameters
_MOST_TURN, _MOST_SHIFT = 0.35, 0.05  # radians and diameters: more is another pose
_LEAST_POINTS = 32


class _Fit(NamedTuple):
    """The visible points of a part at a pose beside what was measured in their directions, in diameters."""

    moved: Float[Array, "m 3"]
    normals: Float[Array, "m 3"]
    residual: Float[Array, " m"]  # along the part's normal
    near: Bool[Array, " m"]  # whether what was measured may be of the part


class _State(NamedTuple):
    step: Int[Array, ""]
    pose: Pose
    change: Scalar


def polished(pose: Pose, part: DevicePart, image: DepthImage) -> Pose:
    """Return a pose T_camera_object moved onto what was measured; the pose itself where that does not become better."""
    surfels, diameter = part.surfels, part.arrays.diameter
    seen = visible_by_splatting(surfels, pose[None], jnp.ones(1, dtype=bool), image.camera, None, _SIGHT).mask
    # Of a closed surface at most about a half is seen at once: the other points would only take time.
    rows, seen = spread_rows(seen, surfels.points.shape[0] // 2)
    middle = surfels.points.mean(axis=0)
    centre = transform_points(pose, middle[None])[0]
    points, directions = (surfels.points[rows] - middle[None]) / diameter, surfels.normals[rows]

    def fit(pose: Pose) -> _Fit:
        moved, normals = transform_points(pose, points), rotate_vectors(pose, directions)
        measured, there = measured_at(image, moved * diameter + centre[None])
        apart = moved - (measured - centre[None]) / diameter
        near = seen & there & ((apart**2).sum(axis=1) <= _GATE**2)
        return _Fit(moved, normals, (normals * apart).sum(axis=1), near)

    def reach(fit: _Fit) -> Scalar:
        apart = jnp.where(fit.near, jnp.abs(fit.residual), jnp.inf)
        median = smallest_at(apart, fit.near.sum(dtype=jnp.int32) // 2)
        return _SPREADS * jnp.clip(jnp.where(jnp.isfinite(median), median, 0), _LEAST_SPREAD, _GATE)

    def moved_on(state: _State) -> _State:
        now = fit(state.pose)
        weights = jnp.where(now.near, jnp.maximum(1 - (now.residual / reach(now)) ** 2, 0) ** 2, 0)
        step = plane_step(now.moved, now.normals, now.residual, weights)
        usable = rotation_is_determined(now.moved, weights) & jnp.isfinite(step).all()
        pose = jnp.where(usable, compose(step, state.pose), state.pose)
        return _State(state.step + 1, pose, motion_between(state.pose, pose))

    def is_moving(state: _State) -> Bool[Array, ""]:
        return (state.step < _ROUNDS) & (state.change > _STILL)

    start = from_rotation_translation(pose[:3, :3], jnp.zeros(3, jnp.float32))
    end = repeat_while(is_moving, moved_on, _State(jnp.int32(0), start, jnp.float32(jnp.inf)), _ROUNDS).pose
    before, after = fit(start), fit(end)
    tolerance = reach(after)

    def cost(fit: _Fit) -> Scalar:
        return jnp.where(seen, jnp.where(fit.near, jnp.minimum(fit.residual**2, tolerance**2), tolerance**2), 0).sum()

    turn = jnp.sqrt(((end[:3, :3] - start[:3, :3]) ** 2).sum() / 2)
    better = (cost(after) < cost(before)) & (turn <= _MOST_TURN) & ((end[:3, 3] ** 2).sum() <= _MOST_SHIFT**2)
    better = better & (after.near.sum(dtype=jnp.int32) >= _LEAST_POINTS)
    shift = diameter * end[:3, 3] + centre - (end[:3, :3] * middle[None]).sum(axis=1)
    return jnp.where(better, from_rotation_translation(end[:3, :3], shift), pose)


polish_one = kept()(polished)


_polish_many = jax.jit(jax.vmap(polished, in_axes=(0, None, None)))


def polish(
    T_camera_object: Float32[np.ndarray, "k 4 4"], part: DevicePart, image: DepthImage
) -> Float32[np.ndarray, "k 4 4"]:
    """Return poses as `polished` moves them."""
    if not len(T_camera_object):
        return T_camera_object
    return call_rows(
        lambda pose: polish_one(pose, part, image), lambda poses: _polish_many(poses, part, image), T_camera_object
    )
