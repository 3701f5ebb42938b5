"""The cells of an object's picture at a pose, as they are predicted and measured, and what a verifier sees of them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.detection._cells import around
from kmn_jax.detection._depth_agreement import DepthImage, depth_at, in_image
from kmn_jax.geometry import transform_points
from kmn_jax.models import VERIFIER_CHANNELS
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, Scalar

_CELLS = 32  # of the grid, along the longer side of the picture
_SPARE, _WIDE_SPARE = 3, 8  # cells beyond it, on each side, for what is counted and for what a verifier sees
PICTURE_SIDE, VERIFIER_SIDE = _CELLS + 2 * _SPARE, _CELLS + 2 * _WIDE_SPARE
PREDICTED_CHANNELS = 0, 3, 10  # of `verifier_cells`: they are the same whatever was measured
_SAMPLES = ((0.0, 0.0), (-0.3, -0.3), (0.3, -0.3), (-0.3, 0.3), (0.3, 0.3))  # places in a cell, in cells
# Lengths are in diameters of the object.
LOOSE = 0.04  # between depths
_ONE_SURFACE = 0.06  # between the depths of neighbouring cells, beyond what the slant of the view explains
_STEEP = 2.5  # cells: that slant
_MOST_GAP, _MOST_DEPTH, _MOST_NOISE = 0.06, 0.5, 0.03  # what a verifier is told of
_HIGHEST = jax.lax.Precision.HIGHEST


class Predicted(NamedTuple):
    """Cells of an object's picture; u and v are directions (u, v, 1) to their centres."""

    mask: Bool[Array, "s s"]
    depth: Float[Array, "s s"]
    normals: Float[Array, "s s 3"]
    u: Float[Array, "s s"]
    v: Float[Array, "s s"]
    pitch: Scalar  # of directions
    nearest: Scalar  # depth of the nearest point
    surface: Float[Array, "m 3"]  # all of the object's, also what is turned away


class Measured(NamedTuple):
    """The same cells of a depth image."""

    in_image: Bool[Array, "s s"]
    there: Bool[Array, "s s"]
    depth: Float[Array, "s s"]
    away: Float[Array, "s s"]  # of the sample nearest to the predicted depth from it
    noise: Float[Array, "s s"]
    points: Float[Array, "s s 3"]
    normals: Float[Array, "s s 3"]
    has_normal: Bool[Array, "s s"]


def verifier_cells(
    T_camera_object: Pose, surfels: Surfels, image: DepthImage, diameter: Scalar
) -> Float[Array, "s s c"]:
    """Return what `PoseVerifier` looks at: an object at a pose and a depth image in the same unit, cell by cell."""
    seen = predicted(T_camera_object, surfels, image, VERIFIER_SIDE)
    found = measured(seen, image, diameter)
    mask, there = seen.mask, found.there
    both = mask & there
    middle = jnp.where(mask, seen.depth, 0).sum() / jnp.maximum(mask.sum(dtype=jnp.float32), 1)

    def within(lengths: Float[Array, "s s"], of: Bool[Array, "s s"], most: float) -> Float[Array, "s s"]:
        return jnp.where(of, jnp.clip(lengths / diameter, -most, most), 0)

    channels = (
        mask,
        there,
        within(found.depth - seen.depth, both, _MOST_GAP) / _MOST_GAP,
        within(seen.depth - middle, mask, _MOST_DEPTH),
        within(found.depth - middle, there, _MOST_DEPTH),
        jnp.where(mask & found.has_normal, (seen.normals * found.normals).sum(axis=-1), 0),
        found.has_normal,
        within(found.away, both, _MOST_GAP) / _MOST_GAP,
        within(found.noise, there, _MOST_NOISE) / _MOST_NOISE,
        jnp.where(
            found.has_normal, -(found.normals * _directions(seen)).sum(axis=-1), 0
        ),  # of what faces the image's plane 1
        found.in_image,
    )
    assert len(channels) == VERIFIER_CHANNELS
    return jnp.stack([channel.astype(jnp.float32) for channel in channels], axis=-1)


def predicted(T_camera_object: Pose, surfels: Surfels, image: DepthImage, side: int = PICTURE_SIDE) -> Predicted:
    """Return the cells of an object's picture at a pose, as the image's camera would see it alone.

    The grid has `side` cells along each side, of which the picture takes at most 32 in the middle.
    """
    spare = (side - _CELLS) // 2
    points = transform_points(T_camera_object, surfels.points)
    normals = jnp.matmul(surfels.normals, T_camera_object[:3, :3].T, precision=_HIGHEST)
    facing = ((points * normals).sum(axis=1) < 0) & (points[:, 2] > 0)
    some = facing.any()
    nearest = jnp.where(some, jnp.where(facing, points[:, 2], jnp.inf).min(), 1)
    z = jnp.where(facing, points[:, 2], nearest)
    directions = points[:, :2] / z[:, None]
    low, high = (
        jnp.where(some, bound(jnp.where(facing[:, None], directions, worst), axis=0), 0)
        for bound, worst in ((jnp.min, jnp.inf), (jnp.max, -jnp.inf))
    )
    # No finer than pixels, nor than surfels are apart, so that there is one in or next to each cell of the surface.
    spacing = jnp.sqrt(surfels.area / surfels.points.shape[0])
    finest = jnp.maximum(spacing / nearest, 1 / image.camera.fx)
    pitch = jnp.maximum((high - low).max() / (_CELLS - 1), finest)
    place = jnp.round((directions - low[None]) / pitch).astype(jnp.int32) + spare
    index = place[:, 1] * side + place[:, 0]
    front = jnp.full(side**2, jnp.inf, jnp.float32).at[jnp.where(facing, index, side**2)].min(z, mode="drop")
    # The surface of a cell is what lies about as near as its nearest point.
    shown = facing & (z <= front[jnp.clip(index, 0, side**2 - 1)] + spacing + pitch * nearest)
    columns = jnp.concatenate([normals, z[:, None], jnp.ones_like(z)[:, None]], axis=1)
    sums = jnp.zeros((side**2, 5), jnp.float32).at[jnp.where(shown, index, side**2)].add(columns, mode="drop")
    mask = (sums[:, 4] > 0).reshape(side, side)
    length = jnp.sqrt(jnp.maximum((sums[:, :3] ** 2).sum(axis=1, keepdims=True), 1e-12))
    steps = (jnp.arange(side, dtype=jnp.float32) - spare) * pitch
    u, v = jnp.meshgrid(low[0] + steps, low[1] + steps)
    depth = (sums[:, 3] / jnp.maximum(sums[:, 4], 1)).reshape(side, side)
    return Predicted(mask, depth, (sums[:, :3] / length).reshape(side, side, 3), u, v, pitch, nearest, points)


def measured(seen: Predicted, image: DepthImage, diameter: Scalar) -> Measured:
    """Return what the same cells are of a depth image; lengths are in its unit."""
    samples = jnp.stack([depth_at(image, seen.u + du * seen.pitch, seen.v + dv * seen.pitch) for du, dv in _SAMPLES])
    real = samples > 0
    there = real.any(axis=0)
    anchor = jnp.where(real[0], samples[0], samples[1:].max(axis=0))
    own = real & (jnp.abs(samples - anchor[None]) < LOOSE * diameter)
    count = jnp.maximum(own.sum(axis=0, dtype=jnp.float32), 1)
    depth = jnp.where(own, samples, 0).sum(axis=0) / count
    noise = jnp.sqrt(jnp.where(own, (samples - depth[None]) ** 2, 0).sum(axis=0) / jnp.maximum(count - 1, 1))
    away = jnp.where(real, jnp.abs(samples - seen.depth[None]), jnp.inf).min(axis=0)
    points = _directions(seen) * depth[..., None]
    reach = _ONE_SURFACE * diameter + _STEEP * seen.pitch * seen.nearest
    (along_u, has_u), (along_v, has_v) = (_slope(points, there, axis, reach) for axis in (1, 0))
    normals = jnp.cross(along_v, along_u)
    length = jnp.sqrt(jnp.maximum((normals**2).sum(axis=-1, keepdims=True), 1e-24))
    normals = normals / length
    normals = jnp.where((normals * points).sum(axis=-1, keepdims=True) > 0, -normals, normals)
    return Measured(
        in_image(image, seen.u, seen.v),
        there,
        depth,
        away,
        noise,
        points,
        normals,
        has_u & has_v & (length[..., 0] > 1e-12),
    )


def _directions(seen: Predicted) -> Float[Array, "s s 3"]:
    """Return the directions (u, v, 1) to the centres of cells."""
    return jnp.stack([seen.u, seen.v, jnp.ones_like(seen.u)], axis=-1)


def _slope(
    points: Float[Array, "s s 3"], there: Bool[Array, "s s"], axis: int, reach: Scalar
) -> tuple[Float[Array, "s s 3"], Bool[Array, "s s"]]:
    """Return the way from cell to cell along an axis, where both are on one surface."""
    points, there = (jnp.swapaxes(grid, 0, axis) for grid in (points, there))
    (before, _, after), (is_before, _, is_after) = around(points, 1, 0.0), around(there, 1, False)
    ways, known = [], []
    for way, is_beside in ((after - points, is_after), (points - before, is_before)):
        same = there & is_beside & (jnp.abs(way[..., 2]) < reach)
        ways.append(jnp.where(same[..., None], way, 0))
        known.append(same)
    return jnp.swapaxes(ways[0] + ways[1], 0, axis), jnp.swapaxes(known[0] | known[1], 0, axis)
