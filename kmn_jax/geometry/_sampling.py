"""Farthest-point sampling."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import InputError, check_shape
from kmn_jax.geometry._rows import real_rows
from kmn_jax.typing import PRNGKey, Scalar

_PADDING, _CHOSEN = -2.0, -1.0  # below every distance, so that neither is chosen while a real point is left


def farthest_point_indices(
    points: Float[Array, "n 3"],
    count: int,
    key: PRNGKey | None = None,
    mask: Bool[Array, " n"] | None = None,
) -> Int[Array, " count"]:
    """Return the indices of `count` points, each the farthest from all those before it.

    Without a key the first is the point farthest from the mean, as in the published network; the mean itself
    then plays no part. With a key the first is drawn uniformly. Ties go to the lower index. Rows that are
    masked out or not finite are never chosen while one is real. Indices are distinct, also among coincident
    points, unless fewer than `count` are real: then the first real index fills the rest. With none real, all
    are 0. Raises InputError if count is not in [1, n], or if points are no array (n, 3). Cost: `count` passes over the
    points.
    """
    check_shape(points, "points", (None, 3))
    total = points.shape[0]
    if not 1 <= count <= total:
        raise InputError(f"count = {count} of {total} points cannot be chosen: take a count between 1 and their number")
    real = real_rows(points, mask)
    x, y, z = jnp.where(real[:, None], points, 0).T
    available = jnp.where(real, jnp.inf, _PADDING).astype(points.dtype)

    # A sum over an axis of length 3 would take CPUs ten times as long.
    def square_distances_to(position: tuple[Scalar, Scalar, Scalar]) -> Float[Array, " n"]:
        return (x - position[0]) ** 2 + (y - position[1]) ** 2 + (z - position[2]) ** 2

    if key is None:
        num_real = jnp.maximum(real.sum(), 1).astype(points.dtype)
        mean = (x.sum() / num_real, y.sum() / num_real, z.sum() / num_real)
        first = _first_largest(jnp.minimum(square_distances_to(mean), available))
    else:
        first = jax.random.categorical(key, jnp.where(real, 0.0, -jnp.inf)).astype(jnp.int32)

    def choose(
        carry: tuple[Float[Array, " n"], Int[Array, ""]], _: None
    ) -> tuple[tuple[Float[Array, " n"], Int[Array, ""]], Int[Array, ""]]:
        distances, latest = carry
        distances = jnp.minimum(distances, square_distances_to((x[latest], y[latest], z[latest])))
        distances = distances.at[latest].min(jnp.asarray(_CHOSEN, distances.dtype))
        return (distances, _first_largest(distances)), latest

    _, indices = jax.lax.scan(choose, (available, first), None, length=count)
    return indices


def _first_largest(values: Float[Array, " n"]) -> Int[Array, ""]:
    """Return what argmax does, as two plain reductions, which CPUs vectorise."""
    index = jnp.arange(values.shape[0], dtype=jnp.int32)
    return jnp.where(values == values.max(), index, values.shape[0]).min()
