"""Planes at some points through all points within a radius: far cheaper than the nearest neighbours of each."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import positive_scalar
from kmn_jax.geometry._knn import squared_distances
from kmn_jax.geometry._normals import _plane_normals
from kmn_jax.geometry._rows import real_rows
from kmn_jax.platforms import by_platform
from kmn_jax.typing import Scalar

_CPU_BLOCK = 64  # queries at once: their distances to a few thousand points stay in a core's cache
_MOST_DISTANCES = 2**24  # at once elsewhere, where every block is a few kernels to start: 64 MiB


class LocalPlanes(NamedTuple):
    """Planes through the points within a radius of q queries; zeros where there is none."""

    normals: Float[Array, "q 3"]  # unit, of arbitrary sign
    heights: Float[Array, " q"]  # of the queries above their planes, along the normals
    residuals: Float[Array, " q"]  # root mean square of the points' distances from the plane
    valid: Bool[Array, " q"]


def normals_within_radius(
    queries: Float[Array, "q 3"],
    points: Float[Array, "n 3"],
    radius: Scalar | float | int,
    mask: Bool[Array, " n"] | None = None,
) -> tuple[Float[Array, "q 3"], Bool[Array, " q"]]:
    """Return unit normals at the queries, of arbitrary sign, and which are valid: see `planes_within_radius`."""
    planes = planes_within_radius(queries, points, radius, mask)
    return planes.normals, planes.valid


def planes_within_radius(
    queries: Float[Array, "q 3"],
    points: Float[Array, "n 3"],
    radius: Scalar | float | int,
    mask: Bool[Array, " n"] | None = None,
) -> LocalPlanes:
    """Return the planes from which the points within a radius of each query spread least.

    Where they are fewer than three, coincident or on a line, there is none: its values are zero and not valid. Points
    masked out or not finite are ignored; queries must be finite. Sums are taken about the mean of the points, so a
    radius below a thousandth of the cloud's extent loses digits. Raises InputError for a radius that is not positive.
    """
    radius = positive_scalar(radius, "radius").astype(jnp.float32)
    count = queries.shape[0]
    if 0 in (count, points.shape[0]):
        return LocalPlanes(jnp.zeros((count, 3)), jnp.zeros(count), jnp.zeros(count), jnp.zeros(count, dtype=bool))
    real = real_rows(points, mask)
    points = jnp.where(real[:, None], points, 0).astype(jnp.float32)
    center = points.sum(axis=0, keepdims=True) / jnp.maximum(real.sum(), 1).astype(jnp.float32)
    points, queries = points - center, queries.astype(jnp.float32) - center
    x, y, z = points.T
    columns = [jnp.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
    # Of a vector's 16 columns: products of 10 are slower on CPUs.
    moments = jnp.stack([*columns, *[jnp.zeros_like(x)] * 6], axis=1)
    moments = jnp.where(real[:, None], moments, 0)

    def sums(block: Float[Array, "b 3"]) -> Float[Array, "b 16"]:
        near = squared_distances(block, points) <= radius**2
        return jnp.matmul(near.astype(jnp.float32), moments, precision=jax.lax.Precision.HIGHEST)

    def in_blocks(queries: Float[Array, "q 3"], size: int) -> Float[Array, "q 16"]:
        num_blocks = -(-count // size)
        blocks = jnp.pad(queries, ((0, num_blocks * size - count), (0, 0))).reshape(num_blocks, size, 3)
        return jax.lax.map(sums, blocks).reshape(-1, 16)[:count]

    large = max(1, min(count, _MOST_DISTANCES // points.shape[0]))
    found = by_platform(queries, cpu=partial(in_blocks, size=_CPU_BLOCK), default=partial(in_blocks, size=large))
    number, *rest = found[:, : len(columns)].T
    normals, valid = _plane_normals(number, rest[:3], rest[3:])
    number = jnp.maximum(number, 1)
    mean = jnp.stack(rest[:3], axis=1) / number[:, None]
    heights = ((queries - mean) * normals).sum(axis=1)
    # The spread along the normal: its square is a quadratic form of the second moments about the mean.
    xx, yy, zz, xy, xz, yz = (total / number for total in rest[3:])
    x, y, z = normals.T
    squares = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
    residuals = jnp.sqrt(jnp.maximum(squares - (mean * normals).sum(axis=1) ** 2, 0))
    return LocalPlanes(
        jnp.where(valid[:, None], normals, 0), jnp.where(valid, heights, 0), jnp.where(valid, residuals, 0), valid
    )
