"""Exact nearest neighbours within a reach, by groups of points that lie together: few distances, not all of them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from kmn_jax.geometry._knn import first_smallest, squared_distances
from kmn_jax.platforms import by_platform
from kmn_jax.typing import Scalar

_MOST = 32  # points of a group
_AT_ONCE = 12  # groups that a block of queries meets before it is asked whether it needs more
_CODE_BITS = 32  # of a place along an axis and the position of its point, sorted as one number
_ROUNDING = 1 - 1e-6  # of squared distances
_EQUAL = 8  # last places by which two ways to compute a squared distance may differ


class PointGroups(NamedTuple):
    """Points in g groups of up to s that lie close together; on accelerators, in their order as given."""

    points: Float[Array, "g s 3"]  # infinite where a place is empty
    rows: Int[Array, "g s"]  # of the points as given; any row where a place is empty

    @property
    def mask(self) -> Bool[Array, "g s"]:
        """Which places hold a point."""
        return jnp.isfinite(self.points[..., 0])


def group_points(points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None) -> PointGroups:
    """Put points into groups of equal size, by halving them along the longest sides of their boxes.

    Points where `mask` is false, which may hold anything, are in no group.
    """
    count = points.shape[0]
    groups = 1 << max(-(-count // _MOST) - 1, 0).bit_length()
    spare = -(-count // groups) * groups - count
    real = jnp.ones(count, dtype=bool) if mask is None else mask
    places = jnp.pad(jnp.where(real[:, None], points, jnp.inf), ((0, spare), (0, 0)), constant_values=jnp.inf)
    rows = by_platform(
        places,
        cpu=lambda places: _split(places, groups),
        default=lambda places: jnp.arange(count + spare, dtype=jnp.int32),
    )
    return PointGroups(places[rows].reshape(groups, -1, 3), jnp.minimum(rows, max(count - 1, 0)).reshape(groups, -1))


def nearest_within(
    queries: Float[Array, "b q 3"], mask: Bool[Array, "b q"], groups: PointGroups, reach: Scalar | float
) -> tuple[Int[Array, "b q"], Float[Array, "b q"]]:
    """Return for each query the row of its nearest point and the distance, infinite where none is within reach.

    What all distances say; of points that are equally near to rounding, the lowest row. On CPUs it is faster the closer
    together the queries of a block are: best as `group_points` put them, wherever they moved as one since. Queries
    where `mask` is false must be finite, and their result means nothing.
    """
    rows, squares = by_platform(
        queries, mask, groups, jnp.asarray(reach, dtype=jnp.float32), cpu=_of_near_groups, default=_of_all
    )
    distance = jnp.sqrt(squares)
    return rows, jnp.where(distance <= reach, distance, jnp.inf)


def _split(points: Float[Array, "n 3"], groups: int) -> Int[Array, " n"]:
    """Return the order in which the points of one group follow those of another; `groups` is a power of two."""
    columns = [points[None, :, axis] for axis in range(3)]
    order = jnp.arange(points.shape[0], dtype=jnp.int32)[None]
    while len(order) < groups:
        place = _along_longest(columns)
        columns, order = [_taken(column, place) for column in columns], _taken(order, place)
        columns, order = [_halved(column) for column in columns], _halved(order)
    return order.reshape(-1)


def _along_longest(columns: list[Float[Array, "p n"]]) -> Int[Array, "p n"]:
    """Return each part's order along the longest side of its box, empty places last.

    The place along that side and the position are one number: CPUs sort plain numbers ten times as fast as pairs.
    """
    lowest, widths = [], []
    for column in columns:
        real = jnp.isfinite(column)
        lowest.append(jnp.where(real, column, jnp.inf).min(axis=1, keepdims=True))
        widths.append(jnp.where(real, column, -jnp.inf).max(axis=1, keepdims=True) - lowest[-1])
    longest = jnp.argmax(jnp.stack(widths), axis=0)
    place, low, width = (
        jnp.where(longest == 0, x, jnp.where(longest == 1, y, z)) for x, y, z in (columns, lowest, widths)
    )
    count = place.shape[1]
    position_bits = (count - 1).bit_length()
    last = 2 ** (_CODE_BITS - position_bits) - 1
    share = jnp.where(jnp.isfinite(place), (place - low) / jnp.where(width > 0, width, 1), jnp.inf)
    step = jnp.where(share <= 1, jnp.minimum((share * last).astype(jnp.uint32), last - 1), last).astype(jnp.uint32)
    code = (step << position_bits) | jnp.arange(count, dtype=jnp.uint32)[None]
    return (jax.lax.sort(code, dimension=1, is_stable=False) & (2**position_bits - 1)).astype(jnp.int32)


def _taken(column: Shaped[Array, "p n"], place: Int[Array, "p n"]) -> Shaped[Array, "p n"]:
    return jnp.take_along_axis(column, place, axis=1)


def _halved(column: Shaped[Array, "p n"]) -> Shaped[Array, "q m"]:
    return column.reshape(2 * column.shape[0], -1)


def _of_all(
    queries: Float[Array, "b q 3"], mask: Bool[Array, "b q"], groups: PointGroups, reach: Scalar
) -> tuple[Int[Array, "b q"], Float[Array, "b q"]]:
    del mask, reach
    place, squares = first_smallest(squared_distances(groups.points.reshape(-1, 3), queries.reshape(-1, 3)))
    return groups.rows.reshape(-1)[place].reshape(queries.shape[:2]), squares.reshape(queries.shape[:2])


class _Search(NamedTuple):
    left: Float[Array, "b g"]  # squared distances that groups are away at least; infinite once they were met
    rows: Int[Array, "b q"]
    squares: Float[Array, "b q"]


def _of_near_groups(
    queries: Float[Array, "b q 3"], mask: Bool[Array, "b q"], groups: PointGroups, reach: Scalar
) -> tuple[Int[Array, "b q"], Float[Array, "b q"]]:
    """Let each block of queries meet the nearest groups, until no other one can have a nearer point within reach."""
    at_once = min(_AT_ONCE, len(groups.points))
    blocks = jnp.arange(len(queries), dtype=jnp.int32)[:, None]

    def unsure(state: _Search) -> Bool[Array, ""]:
        needed = jnp.where(mask, jnp.minimum(state.squares, reach**2), -1).max(axis=1)
        return (state.left.min(axis=1) <= needed).any()

    def meet(state: _Search) -> _Search:
        _, chosen = jax.lax.top_k(-state.left, at_once)
        points = groups.points[chosen].reshape(len(queries), -1, 3)
        rows = groups.rows[chosen].reshape(len(queries), -1)
        x, y, z = ((points[:, :, axis, None] - queries[:, None, :, axis]) ** 2 for axis in range(3))
        bits = (x + y + z).view(jnp.int32)  # squares are in their order, and CPUs find the least in less time
        least = bits.min(axis=1)
        equal = bits <= least[:, None] + _EQUAL  # they may be computed twice, and then not always alike
        row = jnp.where(equal, rows[:, :, None], jnp.iinfo(jnp.int32).max).min(axis=1)
        nearest = least.view(jnp.float32)
        better = (nearest < state.squares) | ((nearest == state.squares) & (row < state.rows))
        return _Search(
            state.left.at[blocks, chosen].set(jnp.inf),
            jnp.where(better, row, state.rows),
            jnp.minimum(nearest, state.squares),
        )

    left = _squared_gaps(_box(queries, mask), _box(groups.points, groups.mask))
    none = jnp.zeros(mask.shape, dtype=jnp.int32), jnp.full(mask.shape, jnp.inf)
    found = jax.lax.while_loop(unsure, meet, _Search(left, *none))
    return found.rows, found.squares


def _box(points: Float[Array, "g s 3"], mask: Bool[Array, "g s"]) -> tuple[Float[Array, "g 3"], Float[Array, "g 3"]]:
    """Return the lowest and highest coordinates of each group, infinitely far from all where it is empty."""
    kept = mask[..., None]
    return jnp.where(kept, points, jnp.inf).min(axis=1), jnp.where(kept, points, -jnp.inf).max(axis=1)


def _squared_gaps(
    boxes: tuple[Float[Array, "b 3"], Float[Array, "b 3"]], others: tuple[Float[Array, "g 3"], Float[Array, "g 3"]]
) -> Float[Array, "b g"]:
    """Return less than the squared distance of any two points of two boxes."""
    gaps = [
        jnp.maximum(
            others[0][None, :, axis] - boxes[1][:, axis, None], boxes[0][:, axis, None] - others[1][None, :, axis]
        )
        for axis in range(3)
    ]
    x, y, z = (jnp.maximum(gap, 0) ** 2 for gap in gaps)
    return (x + y + z) * _ROUNDING
