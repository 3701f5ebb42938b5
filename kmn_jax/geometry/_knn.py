"""Exact nearest neighbours by dense distances, any feature width, one example at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.errors import InputError, check_shape
from kmn_jax.geometry._selection import largest_in_any_order
from kmn_jax.platforms import by_platform

_COORDINATES = 3
_FAR = 1e38  # of masked points, half a squared distance: infinities become no numbers where products are split
_CPU_PARTS = 32  # fewer than about ten ready operations XLA's CPU runtime keeps on one thread
_CPU_ROWS = 16  # for fewer rows, fewer parts: these take longer to compile than they save


def squared_distances(queries: Float[Array, "n c"], points: Float[Array, "m c"]) -> Float[Array, "n m"]:
    """Return all squared Euclidean distances, in float32.

    Points of up to three coordinates are compared coordinate by coordinate, which is exact to rounding wherever
    they are. Wider features go through one matrix product at full float32 precision, so that the
    error is a rounding of the squared distances from the origin.
    """
    queries, points = queries.astype(jnp.float32), points.astype(jnp.float32)
    if points.shape[1] <= _COORDINATES:
        columns = [queries[:, i, None] - points[None, :, i] for i in range(points.shape[1])]
        return sum((column**2 for column in columns[1:]), columns[0] ** 2)
    product = jnp.matmul(queries, points.T, precision=jax.lax.Precision.HIGHEST)
    squares = (queries**2).sum(axis=-1)[:, None] + (points**2).sum(axis=-1)[None, :]
    return jnp.maximum(squares - 2 * product, 0)


def k_nearest(
    queries: Float[Array, "n c"],
    points: Float[Array, "m c"],
    k: int,
    mask: Bool[Array, " m"] | None = None,
) -> Int[Array, "n k"]:
    """Return for each query the indices of its k nearest points, in no promised order but for repeats.

    A query that is itself one of the points finds itself among them, unless k others are as near to float32
    (see `squared_distances`). Points where `mask` is false are never found; with fewer than k real points, the
    list ends in repeats of the nearest one, so that a maximum over neighbours stays right. On CPUs, ties go to the
    lower index. All but masked points must be finite. Raises InputError if k is not in [1, m], or if queries and points
    have not the same number of coordinates.
    """
    check_shape(points, "points", (None, None))
    check_shape(queries, "queries", (None, points.shape[1]))
    _check_k(k, points.shape[0])
    if queries.shape[0] == 0:
        return jnp.zeros((0, k), dtype=jnp.int32)
    queries, points = _centered(queries, points, mask)
    selected = by_platform(
        queries,
        points,
        mask,
        cpu=partial(_k_smallest_in_parts, k=k),
        default=partial(_k_smallest_at_once, k=k),
    )
    return _repeat_nearest(*selected)


def neighbor_graph(points: Float[Array, "n c"], k: int, mask: Bool[Array, " n"] | None = None) -> Int[Array, "n k"]:
    """Return for each point its k nearest among all of them, itself included: `k_nearest`, but for ties.

    On CPUs it is faster the nearer points of similar index are (see `space_filling_order`): a point's selection starts
    with those of about its own index, and the sooner it meets the nearest, the fewer others it keeps for a while.
    Which of several equally far points is found depends on the device and on n, padding included.
    """
    _check_k(k, points.shape[0])
    points, _ = _centered(points, points, mask)
    selected = by_platform(
        points,
        mask,
        cpu=partial(_k_smallest_own_part_first, k=k),
        default=lambda points, mask: _k_smallest_at_once(points, points, mask, k),
    )
    return _repeat_nearest(*selected)


def _check_k(k: int, count: int) -> None:
    if not 1 <= k <= count:
        raise InputError(f"k = {k} neighbours asked of {count} points: choose k between 1 and their number")


def _repeat_nearest(values: Float[Array, "n k"], indices: Int[Array, "n k"]) -> Int[Array, "n k"]:
    """Put the nearest in the place of masked points.

    Without the barrier XLA merges the slice into the selection, which then falls back to a full sort; with
    the values unused, it lets the parts share one buffer for them, and so wait for each other.
    """
    values, indices = jax.lax.optimization_barrier((values, indices))
    return jnp.where(jnp.isfinite(values), indices, indices[:, :1])


def _k_smallest(
    queries: Float[Array, "n c"],
    points: Float[Array, "m c"],
    mask: Bool[Array, " m"] | None,
    k: int,
    select: Callable[..., Any] = jax.lax.top_k,
) -> tuple[Float[Array, "n k"], Int[Array, "n k"]]:
    distances = squared_distances(queries, points)
    if mask is not None:
        distances = jnp.where(mask[None, :], distances, jnp.inf)
    values, indices = select(-distances, k)
    # Under shard_map XLA fails where one barrier, the caller's, takes both results as they are.
    return jax.lax.optimization_barrier(values), jax.lax.optimization_barrier(indices)


def _k_smallest_at_once(
    queries: Float[Array, "n c"], points: Float[Array, "m c"], mask: Bool[Array, " m"] | None, k: int
) -> tuple[Float[Array, "n k"], Int[Array, "n k"]]:
    """The same for accelerators, where what takes time is to write distances and to read them.

    Wider features are multiplied such that the product itself tells which point is nearer: q . p - |p|^2 / 2 is minus
    half the squared distance, but for a term of the query's own. Values are these, infinite for masked points.
    """
    if points.shape[1] <= _COORDINATES:
        return _k_smallest(queries, points, mask, k, largest_in_any_order)
    queries, points = queries.astype(jnp.float32), points.astype(jnp.float32)
    halves = 0.5 * (points**2).sum(axis=1, keepdims=True)
    if mask is not None:
        points, halves = jnp.where(mask[:, None], points, 0), jnp.where(mask[:, None], halves, _FAR)
    queries = jnp.concatenate([queries, jnp.ones((queries.shape[0], 1), queries.dtype)], axis=1)
    points = jnp.concatenate([points, -halves], axis=1)
    values, indices = largest_in_any_order(jnp.matmul(queries, points.T, precision=jax.lax.Precision.HIGHEST), k)
    values = jnp.where(values < -_FAR / 2, -jnp.inf, values)
    return jax.lax.optimization_barrier(values), jax.lax.optimization_barrier(indices)


def _k_smallest_in_parts(
    queries: Float[Array, "n c"], points: Float[Array, "m c"], mask: Bool[Array, " m"] | None, k: int
) -> tuple[Float[Array, "n k"], Int[Array, "n k"]]:
    """The same for CPUs, where one `top_k` runs on one core, but independent ones run side by side."""
    size = _part_size(queries.shape[0])
    parts = [_k_smallest(queries[i : i + size], points, mask, k) for i in range(0, queries.shape[0], size)]
    values, indices = zip(*parts, strict=True)
    return jnp.concatenate(values), jnp.concatenate(indices)


def _part_size(rows: int) -> int:
    return max(-(-rows // _CPU_PARTS), _CPU_ROWS)


def _k_smallest_own_part_first(
    points: Float[Array, "n c"], mask: Bool[Array, " n"] | None, k: int
) -> tuple[Float[Array, "n k"], Int[Array, "n k"]]:
    """The same for points among themselves: each part meets its own points first, then those after, then before.

    XLA's `top_k` on CPUs passes the candidates once and keeps those that are the k smallest so far.
    """
    count = points.shape[0]
    size = _part_size(count)
    twice = jnp.concatenate([points, points])
    mask_twice = None if mask is None else jnp.concatenate([mask, mask])
    parts = [
        _k_smallest(
            points[i : i + size], twice[i : i + count], None if mask_twice is None else mask_twice[i : i + count], k
        )
        for i in range(0, count, size)
    ]
    values, after_start = (jnp.concatenate(each) for each in zip(*parts, strict=True))
    indices = after_start + jnp.arange(count, dtype=jnp.int32)[:, None] // size * size
    return values, jnp.where(indices < count, indices, indices - count)


def nearest(
    queries: Float[Array, "n c"],
    points: Float[Array, "m c"],
    mask: Bool[Array, " m"] | None = None,
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Return for each query the index of its nearest point and the distance to it, infinite where none is real."""
    queries, points = _centered(queries, points, mask)
    distances = squared_distances(points, queries)
    if mask is not None:
        distances = jnp.where(mask[:, None], distances, jnp.inf)
    rows, smallest = first_smallest(distances)
    return rows, jnp.sqrt(smallest)


def first_smallest(columns: Float[Array, "m n"]) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Return of each column the first row with its smallest value, and the value.

    As plain reductions along whole rows, which CPUs vectorise; an argmin takes them six times as long.
    """
    count = columns.shape[0]
    smallest = columns.min(axis=0)
    rows = jnp.where(columns == smallest[None], jnp.arange(count, dtype=jnp.int32)[:, None], count).min(axis=0)
    return jnp.minimum(rows, count - 1), smallest  # beyond, if it is not a number


def largest_distance(points: Float[Array, "n c"]) -> Float[Array, ""]:
    """Return the largest distance between any two points; time grows with the square of their number."""
    return jnp.sqrt(squared_distances(points, points).max())


def _centered(
    queries: Float[Array, "n c"], points: Float[Array, "m c"], mask: Bool[Array, " m"] | None
) -> tuple[Float[Array, "n c"], Float[Array, "m c"]]:
    """Move the (real) points' mean to the origin: the expanded square loses digits with distance from it."""
    if points.shape[1] <= _COORDINATES:
        return queries, points
    queries, points = queries.astype(jnp.float32), points.astype(jnp.float32)
    if mask is None:
        mean = points.mean(axis=0, keepdims=True)
    else:
        count = jnp.maximum(mask.sum(), 1).astype(jnp.float32)
        mean = jnp.where(mask[:, None], points, 0).sum(axis=0, keepdims=True) / count
    return queries - mean, points - mean
