"""Exact nearest neighbours by dense distances, any feature width, one example at a time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def squared_distances(queries: Float[Array, "n c"], points: Float[Array, "m c"]) -> Float[Array, "n m"]:
    """Return all squared Euclidean distances, in float32 and clipped at zero.

    The product runs at full float32 precision whatever the default: a neighbour list is only as good as
    the small differences between large squares.
    """
    queries, points = queries.astype(jnp.float32), points.astype(jnp.float32)
    product = jnp.matmul(queries, points.T, precision=jax.lax.Precision.HIGHEST)
    squares = (queries**2).sum(axis=-1)[:, None] + (points**2).sum(axis=-1)[None, :]
    return jnp.maximum(squares - 2 * product, 0)


def k_nearest(
    queries: Float[Array, "n c"],
    points: Float[Array, "m c"],
    k: int,
    mask: Bool[Array, " m"] | None = None,
) -> Int[Array, "n k"]:
    """Return for each query the indices of its k nearest points, in no promised order.

    A query that is itself one of the points finds itself among them. Points where `mask` is false are never
    found while at least k are real; with fewer real points the list repeats the nearest one, so that a maximum
    over neighbours stays right. Ties go to the lower index. Raises ValueError if k is not in [1, m].
    """
    if not 1 <= k <= points.shape[0]:
        raise ValueError(f"k = {k} neighbours asked of {points.shape[0]} points: choose k between 1 and their number")
    distances = squared_distances(queries, points)
    if mask is not None:
        distances = jnp.where(mask[None, :], distances, jnp.inf)
    negated, indices = jax.lax.top_k(-distances, k)
    if mask is not None:
        indices = jnp.where(jnp.isfinite(negated), indices, indices[:, :1])
    return indices


def nearest(
    queries: Float[Array, "n c"],
    points: Float[Array, "m c"],
    mask: Bool[Array, " m"] | None = None,
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Return for each query the index of its nearest point and the distance to it.

    The distance is infinite where no point is real. It is taken from the differences themselves, so that
    it is exact near zero, where the expanded square of `squared_distances` is not.
    """
    distances = squared_distances(queries, points)
    if mask is not None:
        distances = jnp.where(mask[None, :], distances, jnp.inf)
    indices = jnp.argmin(distances, axis=-1)
    exact = jnp.sqrt(((queries - points[indices]) ** 2).sum(axis=-1))
    return indices, jnp.where(jnp.isfinite(distances.min(axis=-1)), exact, jnp.inf)
