"""Subsets of a cloud in arrays of a fixed size: radius crop and voxel thinning."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import positive_scalar
from kmn_jax.geometry._rows import real_rows
from kmn_jax.typing import PRNGKey, Scalar


class Selection(NamedTuple):
    """Rows chosen from a cloud, in ascending order and padded to a fixed capacity."""

    indices: Int[Array, " capacity"]  # 0 where padded
    mask: Bool[Array, " capacity"]  # false where padded
    overflow: Bool[Array, ""]  # true if more rows qualified than fit, so that some are missing


def radius_crop(
    points: Float[Array, "n c"],
    center: Float[Array, " 3"],
    radius: Scalar | float | int,
    capacity: int,
    key: PRNGKey | None = None,
    mask: Bool[Array, " n"] | None = None,
) -> Selection:
    """Choose the points within a radius of a center; the first three columns are positions.

    If more than `capacity` lie inside, those kept are drawn uniformly without replacement with `key`, or without
    a key are evenly spaced in the order of the rows (the first ones alone would be one side of a scan). The
    boundary counts as inside; rows masked out or not finite never do. Raises ValueError for a capacity below 1
    or fewer than three columns, InputError for a radius that is not positive.
    """
    if points.shape[1] < 3:
        raise ValueError(f"points has {points.shape[1]} columns, but the first three must be positions")
    radius = positive_scalar(radius, "radius").astype(points.dtype)
    x, y, z = (points[:, axis] - center[axis] for axis in range(3))
    return _select(real_rows(points, mask) & (x**2 + y**2 + z**2 <= radius**2), capacity, key)


def voxel_thin(
    points: Float[Array, "n 3"],
    voxel_size: Scalar | float | int,
    capacity: int,
    mask: Bool[Array, " n"] | None = None,
) -> Selection:
    """Choose one point of every occupied voxel: the one nearest to the voxel's center.

    Voxels are half-open cubes with a corner at the origin, so the choice neither depends on the other voxels' points
    nor on the order of the rows, but that of points equally near the lowest index is taken. If more than
    `capacity` voxels are occupied, those kept are evenly spaced in the order of the rows. Rows masked out or not
    finite are never chosen. Raises ValueError for a capacity below 1, InputError for a size that is not positive.
    """
    size = positive_scalar(voxel_size, "voxel_size").astype(points.dtype)
    real = real_rows(points, mask)
    scaled = jnp.where(real[:, None], points / size, 0)
    voxels = jnp.floor(scaled)  # kept as floats: an int32 would overflow for a tiny size
    offsets = ((scaled - voxels - 0.5) ** 2).sum(axis=1)
    rows = jnp.arange(points.shape[0])
    padding = (~real).astype(jnp.int32)
    *voxel, _, order = jax.lax.sort((padding, *voxels.T, offsets, rows), num_keys=6)
    differs = jnp.stack([part[1:] != part[:-1] for part in voxel]).any(axis=0)
    leads = jnp.concatenate([jnp.ones(min(1, points.shape[0]), dtype=bool), differs])
    return _select(real & jnp.zeros_like(real).at[order].set(leads), capacity)


def _select(qualified: Bool[Array, " n"], capacity: int, key: PRNGKey | None = None) -> Selection:
    if capacity < 1:
        raise ValueError(f"capacity = {capacity} leaves no room: choose at least 1")
    count = qualified.sum(dtype=jnp.int32)
    slots = jnp.arange(capacity, dtype=jnp.int32)
    filled = slots < count
    if key is not None:
        # Random numbers rank the rows that qualify; only the first `capacity` of them stay.
        rank = jax.random.uniform(key, qualified.shape).at[...].add(jnp.where(qualified, 1.0, 0.0))
        kept = jax.lax.top_k(rank, min(capacity, qualified.shape[0]))[1]
        qualified = qualified & jnp.zeros_like(qualified).at[kept].set(True)
        ordinals = slots
    else:
        # floor(slot * count / capacity), split so that the product stays within int32.
        spread = slots * (count // capacity) + slots * (count % capacity) // capacity
        ordinals = jnp.where(count > capacity, spread, slots)
    indices = jnp.searchsorted(jnp.cumsum(qualified), ordinals + 1)
    return Selection(jnp.where(filled, indices, 0), filled, count > capacity)
