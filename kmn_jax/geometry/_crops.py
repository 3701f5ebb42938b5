"""The points of a cloud around one of them, drawn into arrays of a fixed size, and how they are drawn."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.programs import compiled_size
from kmn_jax.typing import PRNGKey, Scalar

_TINY = 1e-30  # keeps sums of nothing from dividing by zero


class PaddedCloud(NamedTuple):
    """A cloud in its sensor's frame, padded to a capacity: the sensor is at the origin."""

    points: Float[Array, "r 3"]
    mask: Bool[Array, " r"]  # false for padding


class Crop(NamedTuple):
    """Points around a seed point, which is the origin and the first of them; axes are the cloud's.

    If `valid` is false, the seed is none or too few points are around it; all is finite even so.
    """

    points: Float[Array, "n 3"]
    mask: Bool[Array, " n"]  # false for padding, where points are zero
    seed: Float[Array, "3"]  # in the cloud's frame
    valid: Bool[Array, ""]


def pad_cloud(points: Float32[np.ndarray, "n 3"], least: int = 2) -> PaddedCloud:
    """Return points with zeros after them: few capacities, powers of two of at least `least`, are ever compiled for."""
    capacity = max(least, compiled_size(len(points)))
    padded = np.zeros((capacity, 3), dtype=np.float32)
    padded[: len(points)] = points
    return PaddedCloud(jnp.asarray(padded), jnp.asarray(np.arange(capacity) < len(points)))


def crop_around(
    key: PRNGKey, cloud: PaddedCloud, seed_row: Int[Array, ""], radius: Scalar, num_points: int, min_points: int
) -> Crop:
    """Draw up to `num_points` points within a radius of the one in a row, that one first, evenly over the rows.

    With fewer than `min_points` there, or a row of padding, the crop is not valid.
    """
    x, y, z = (cloud.points[:, axis] - cloud.points[seed_row, axis] for axis in range(3))
    found = cloud.mask[seed_row]
    inside = found & cloud.mask & (x**2 + y**2 + z**2 <= radius**2)
    rows, mask, _ = draw_rows(key, inside.astype(jnp.float32), seed_row, found, num_points, num_points)
    seed = jnp.where(found, cloud.points[seed_row], 0)
    points = jnp.where(mask[:, None], cloud.points[rows] - seed[None], 0)
    spare = num_points - rows.shape[0]
    return Crop(
        jnp.pad(points, ((0, spare), (0, 0))),
        jnp.pad(mask, (0, spare)),
        seed,
        inside.sum(dtype=jnp.int32) >= min_points,
    )


def draw_rows(
    key: PRNGKey, weights: Float[Array, " r"], seed_row: Int[Array, ""], found: Bool[Array, ""], many: int, few: int
) -> tuple[Int[Array, " m"], Bool[Array, " m"], Int[Array, " n"]]:
    """Return up to `many` rows, the seed's first; which of them there are, all in front; and `few` places among them.

    Both draws are without replacement and in proportion to the weights, as far as no row can be drawn twice: where the
    many include all of the heavy rows, the few still prefer them. `found` tells whether the seed is one.
    """
    many_key, few_key = jax.random.split(key)
    others = min(many, weights.shape[0]) - 1
    weights = weights.at[seed_row].set(0)
    likely = _likelihoods(weights, others)
    rows, there = _systematic(many_key, likely, others)
    again = jnp.where(there, weights[rows] / jnp.where(there, likely[rows], 1), 0)
    count = min(few - 1, others)
    chosen, _ = _systematic(few_key, _likelihoods(again, count), count)
    total = there.sum(dtype=jnp.int32)
    kept = jnp.where(total > count, chosen, jnp.arange(count, dtype=jnp.int32))
    rows = jnp.concatenate([seed_row[None].astype(jnp.int32), rows])
    return rows, jnp.concatenate([found[None], there]), jnp.concatenate([jnp.zeros(1, dtype=jnp.int32), 1 + kept])


def even_rows(place: Int[Array, " p"], total: Int[Array, ""], count: int) -> Int[Array, " p"]:
    """Return place * total // count, the rows of `count` places that lie evenly among `total`; no product overflows."""
    return place * (total // count) + place * (total % count) // count


def spread_rows(mask: Bool[Array, " n"], count: int) -> tuple[Int[Array, " c"], Bool[Array, " c"]]:
    """Return rows where a mask is true, evenly chosen among them if they are more than `count`, and which are real."""
    count = min(count, mask.shape[0])
    total = mask.sum(dtype=jnp.int32)
    order = jnp.nonzero(mask, size=mask.shape[0], fill_value=0)[0]
    place = jnp.arange(count, dtype=jnp.int32)
    return order[jnp.where(total > count, even_rows(place, total, count), place)], place < total


def _systematic(
    key: PRNGKey, likely: Float[Array, " r"], count: int
) -> tuple[Int[Array, " count"], Bool[Array, " count"]]:
    """Draw rows without replacement, each as likely as said, and tell which of the `count` there are.

    Rows lie side by side, each as long as it is likely, and one point in every unit of length, all at one random
    distance from its beginning, names a row.
    """
    if count == 0:
        return jnp.zeros(0, dtype=jnp.int32), jnp.zeros(0, dtype=bool)
    unit = min(2**16, 2**30 // count)
    ends = jnp.cumsum(jnp.ceil(likely * unit).astype(jnp.int32))
    places = jax.random.randint(key, (), 0, unit) + unit * jnp.arange(count, dtype=jnp.int32)
    rows = jnp.minimum(jnp.searchsorted(ends, places, side="right"), likely.shape[0] - 1).astype(jnp.int32)
    return rows, places < ends[-1]


def _likelihoods(weights: Float[Array, " r"], count: int) -> Float[Array, " r"]:
    """Return how likely each row is drawn: in proportion to its weight, at most 1, about `count` in sum."""
    scale = count / jnp.maximum(weights.sum(), _TINY)
    for _ in range(3):  # what one row cannot have falls to the others
        full = weights * scale >= 1
        rest = jnp.maximum(jnp.where(full, 0, weights).sum(), _TINY)
        scale = jnp.maximum(scale, (count - full.sum(dtype=jnp.float32)) / rest)
    some = weights > 0
    return jnp.where(some, jnp.where(some.sum() <= count, 1, jnp.minimum(weights * scale, 1)), 0)
