"""Surface normals by local principal component analysis, from clouds and from depth maps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import InputError, positive_scalar
from kmn_jax.geometry._eigen import dominant_eigenvector
from kmn_jax.geometry._knn import k_nearest
from kmn_jax.geometry._rows import real_rows
from kmn_jax.typing import Mask, Normals, Points, Scalar

_MAX_DISTANCES = 2**24  # distances held at once: 64 MiB of float32
_MIN_FLATNESS = 1e-5  # of a neighbourhood's squared width to its squared length: below it is a line


def estimate_normals(
    points: Float[Array, "n 3"],
    k: int = 30,
    mask: Bool[Array, " n"] | None = None,
    max_radius: Scalar | float | int | None = None,
) -> tuple[Normals, Mask]:
    """Return unit normals of an unorganised cloud, of arbitrary sign, and which of them are valid.

    A normal is the direction in which the k nearest points (itself included; fewer if fewer are real, and only those
    within `max_radius` if it is given) spread least. Where they are fewer than three, coincident or on a line,
    the normal is zero and not valid, as for rows masked out or not finite; it is never NaN. Raises ValueError
    for an empty cloud or k below 3, InputError for a radius that is not positive.

    Cost: n^2 distances and a selection of k from each row, in blocks of at most 64 MiB. Thin a large cloud
    first, or use `depth_normals`, which costs a fixed number of operations per pixel.
    """
    total = points.shape[0]
    if total < 1:
        raise InputError("points is empty, so there is nothing to take normals of")
    if k < 3:
        raise InputError(f"k = {k} neighbours define no plane: choose at least 3")
    radius = jnp.inf if max_radius is None else positive_scalar(max_radius, "max_radius").astype(jnp.float32)
    real = real_rows(points, mask)
    centred = jnp.where(real[:, None], points, 0).astype(jnp.float32)
    centred = centred - centred.sum(axis=0, keepdims=True) / jnp.maximum(real.sum(), 1).astype(jnp.float32)
    # Padding goes farther off than any two real points are apart: it is a neighbour only where real ones run out.
    extent = jnp.sqrt(jnp.where(real, (centred**2).sum(axis=1), 0).max())
    centred = jnp.where(real[:, None], centred, 4 * extent + 1)

    def block_normals(queries: Float[Array, "b 3"]) -> tuple[Float[Array, "b 3"], Bool[Array, " b"]]:
        neighbours = k_nearest(queries, centred, min(k, total))
        offsets = [centred[:, axis][neighbours] - queries[:, axis, None] for axis in range(3)]
        square_distances = offsets[0] ** 2 + offsets[1] ** 2 + offsets[2] ** 2
        used = real[neighbours] & (square_distances <= radius**2)
        x, y, z = (jnp.where(used, offset, 0) for offset in offsets)
        first, second = [[part.sum(axis=1) for part in parts] for parts in ([x, y, z], _products(x, y, z))]
        return _plane_normals(used.sum(axis=1).astype(jnp.float32), first, second)

    block = max(1, min(total, _MAX_DISTANCES // total))
    num_blocks = -(-total // block)
    queries = jnp.pad(centred, ((0, num_blocks * block - total), (0, 0))).reshape(num_blocks, block, 3)
    normals, planar = jax.lax.map(block_normals, queries)
    valid = planar.reshape(-1)[:total] & real
    return jnp.where(valid[:, None], normals.reshape(-1, 3)[:total], 0), valid


def orient_to_camera(points: Points, normals: Normals, camera_position: Float[Array, " 3"] | None = None) -> Normals:
    """Flip the normals that point away from the camera, which is at the origin unless given."""
    to_camera = -points if camera_position is None else camera_position[None, :] - points
    away = (normals * to_camera).sum(axis=1, keepdims=True) < 0
    return jnp.where(away, -normals, normals)


def depth_to_points(depth: Float[Array, "h w"], intrinsics: Float[Array, "3 3"]) -> Float[Array, "h w 3"]:
    """Return the points of a depth map in the camera frame: x right, y down, z = depth.

    The centre of the first pixel has the image coordinates (0, 0). Pixels without a depth (not above zero,
    NaN or infinite) give the zero point.
    """
    height, width = depth.shape
    z = jnp.where(_has_depth(depth), depth, 0)
    row = jnp.broadcast_to(jnp.arange(height, dtype=depth.dtype)[:, None], depth.shape)
    column = jnp.broadcast_to(jnp.arange(width, dtype=depth.dtype)[None, :], depth.shape)
    y = (row - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (column - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    return jnp.stack([x * z, y * z, z], axis=-1)


def depth_normals(
    depth: Float[Array, "h w"],
    intrinsics: Float[Array, "3 3"],
    window_radius: int = 2,
    max_jump: Scalar | float | int | None = None,
) -> tuple[Float[Array, "h w 3"], Bool[Array, "h w"]]:
    """Return unit normals of a depth map, pointing to the camera, and which of them are valid.

    Each is the normal of the plane through the pixels of a square window, (2 window_radius + 1)^2 of them, that have a
    depth and differ in it from the centre by at most `max_jump`, a length. Unless given, that is 4 times the length
    which the window's radius covers at that depth: surfaces tilted by up to 76 degrees count as connected, and the
    bound follows depth and resolution. Normals are zero and not valid at pixels without a depth and where those
    pixels are fewer than three or on a line. Raises ValueError for a window_radius below 1.
    """
    if window_radius < 1:
        raise InputError(f"window_radius = {window_radius} leaves one pixel and no plane: choose at least 1")
    height, width = depth.shape
    real = _has_depth(depth)
    points = list(jnp.moveaxis(depth_to_points(depth, intrinsics).astype(jnp.float32), -1, 0))
    if max_jump is None:
        focal_length = jnp.sqrt(jnp.abs(intrinsics[0, 0] * intrinsics[1, 1])).astype(jnp.float32)
        jump = (4 * window_radius / focal_length) * points[2]
    else:
        jump = jnp.full(depth.shape, positive_scalar(max_jump, "max_jump").astype(jnp.float32))
    border = (window_radius, window_radius)
    padded_points = [jnp.pad(plane, (border, border)) for plane in points]
    padded_real = jnp.pad(real, (border, border))
    side = 2 * window_radius + 1

    # One shifted image at a time, added to ten sums per pixel: the windows themselves are never stored.
    def add_offset(step: Int[Array, ""], sums: list[Float[Array, "h w"]]) -> list[Float[Array, "h w"]]:
        down, right = step // side, step % side
        offsets = [
            jax.lax.dynamic_slice(padded, (down, right), depth.shape) - plane
            for padded, plane in zip(padded_points, points, strict=True)
        ]
        used = jax.lax.dynamic_slice(padded_real, (down, right), depth.shape) & (jnp.abs(offsets[2]) <= jump)
        x, y, z = (jnp.where(used, offset, 0) for offset in offsets)
        added = [used.astype(jnp.float32), x, y, z, *_products(x, y, z)]
        return [total + term for total, term in zip(sums, added, strict=True)]

    sums = jax.lax.fori_loop(0, side**2, add_offset, [jnp.zeros(depth.shape, jnp.float32)] * 10, unroll=side)
    count, *moments = (total.reshape(-1) for total in sums)
    normals, planar = _plane_normals(count, moments[:3], moments[3:])
    valid = planar & real.reshape(-1)
    normals = orient_to_camera(jnp.stack(points, axis=-1).reshape(-1, 3), jnp.where(valid[:, None], normals, 0))
    return normals.reshape(height, width, 3), valid.reshape(height, width)


def _products(x: Float[Array, "..."], y: Float[Array, "..."], z: Float[Array, "..."]) -> list[Float[Array, "..."]]:
    return [x * x, y * y, z * z, x * y, x * z, y * z]


def _plane_normals(
    count: Float[Array, " n"], first: list[Float[Array, " n"]], second: list[Float[Array, " n"]]
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"]]:
    """Return the directions of least spread, and whether a plane is defined, from the sums of offsets and products."""
    scale = 1 / jnp.maximum(count, 1)
    squared_mean = _products(*(part * scale for part in first))
    covariance = [part * scale - square for part, square in zip(second, squared_mean, strict=True)]
    spread = covariance[0] + covariance[1] + covariance[2]
    xx, yy, zz, xy, xz, yz = (part / jnp.where(spread > 0, spread, 1) for part in covariance)
    # The sum of the principal minors is, with the trace scaled to one, about the second eigenvalue over the first.
    flatness = (xx * yy - xy**2) + (xx * zz - xz**2) + (yy * zz - yz**2)
    # trace * I - covariance turns the least eigenvalue into the largest.
    turned = jnp.array([[1 - xx, -xy, -xz], [-xy, 1 - yy, -yz], [-xz, -yz, 1 - zz]])
    normals = jax.vmap(dominant_eigenvector, in_axes=2)(turned)
    return normals, (count >= 3) & (spread > 0) & (flatness > _MIN_FLATNESS)


def _has_depth(depth: Float[Array, "h w"]) -> Bool[Array, "h w"]:
    return jnp.isfinite(depth) & (depth > 0)
