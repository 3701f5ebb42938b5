"""Which poses stand together: one pose a copy, and no two parts in one place."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._mapping import map_real
from kmn_jax.geometry import compose, first_smallest, inverse, safe_norm, squared_distances, transform_points
from kmn_jax.pose import mssd
from kmn_jax.programs import kept
from kmn_jax.typing import Normals, Points, Pose, Scalar

DEPTH = 0.05  # diameters: a point so far below another part's surface is inside of it
OVERLAP = 0.15  # share of a part's points that may be inside of another part, or on the same surface
_CONTEST = 0.1  # difference of scores up to which another pose may turn out to be better
_POINTS = 128  # on the surface, that are compared
_ALIKE = 0.5  # cosine of normals


class Selection(NamedTuple):
    """Which poses stand, and by how much each scores above the best other pose for its place."""

    kept: Bool[Array, " s"]
    gap: Float[Array, " s"]  # of what is kept; the score itself where nothing competes
    rivalled: Bool[Array, " s"]  # whether something competes
    contenders: Bool[Array, " s"]  # the best other pose for the place of each that is kept, if nearly as good


def select(
    poses: Float[Array, "s 4 4"],
    score: Float[Array, " s"],
    usable: Bool[Array, " s"],
    part: DevicePart,
    contest: float = _CONTEST,
) -> Selection:
    """Choose among poses with scores of zero and above: from the best on, each unless a better one excludes it.

    Poses that are the same, up to symmetry, exclude each other; of those that remain, such as share a place. Equal
    scores go by their order.
    """
    points, normals = part.arrays.points[:_POINTS], part.arrays.normals[:_POINTS]
    diameter = part.arrays.diameter
    middle = points.mean(axis=0)
    centers = jax.vmap(transform_points, in_axes=(0, None))(poses, middle[None])[:, 0]
    apart = jnp.sqrt(((centers[:, None] - centers[None]) ** 2).sum(axis=2))
    spacing = jnp.sqrt(part.surfels.area / points.shape[0])
    radius = safe_norm(points - middle[None]).max()
    margin = DEPTH * diameter + spacing
    touching = 2 * radius + margin  # farther apart, no point of one is in or on the other

    def same(row: Int[Array, ""]) -> Bool[Array, " s"]:
        # The mean of the points moves no farther than the farthest of them.
        near = (apart[row] <= part.reach) & usable
        return map_real(lambda pose: mssd(poses[row], pose, points, part.symmetries) <= part.reach, near, poses)

    one_each, _ = _greedy(score, usable, same)

    def clashing(row: Int[Array, ""]) -> Bool[Array, " s"]:
        to_row = jax.vmap(lambda pose: compose(inverse(poses[row]), pose))(poses)
        shares = [_shares_in_box(ways, points, margin) for ways in (to_row, jax.vmap(inverse)(to_row))]
        near = (apart[row] <= touching) & one_each & (jnp.maximum(*shares) > OVERLAP)

        def clash(pose: Pose) -> Bool[Array, ""]:
            return overlap(poses[row], pose, points, normals, spacing, DEPTH * diameter) > OVERLAP

        return map_real(clash, near, poses)

    kept, clash = _greedy(score, one_each, clashing)
    # A pose that a better one has ruled out elsewhere is no rival here.
    better = (clash & (score[:, None] > score[None])).astype(jnp.int32)
    alone = better.sum(axis=0)[None] == better
    beaten = one_each & ~kept
    rivals = clash & beaten[None] & alone
    gap = score - jnp.where(rivals, score[None], 0).max(axis=1, initial=0)
    others = jnp.where(clash & beaten[None], score[None], -jnp.inf)
    contested = kept & (others.max(axis=1) >= score - contest)
    contenders = jnp.zeros_like(kept).at[others.argmax(axis=1)].max(contested)
    return Selection(kept, gap, rivals.any(axis=1), contenders)


def _greedy(
    score: Float[Array, " s"], usable: Bool[Array, " s"], excluded_by: Callable[[Int[Array, ""]], Bool[Array, " s"]]
) -> tuple[Bool[Array, " s"], Bool[Array, "s s"]]:
    """Take rows from the best score on, each unless a taken one excludes it; and tell what each taken one excludes."""
    places = jnp.arange(len(score))
    none = jnp.zeros(len(score), dtype=bool)

    def step(out: Bool[Array, " s"], row: Int[Array, ""]) -> tuple[Bool[Array, " s"], tuple[Array, Array]]:
        take = usable[row] & ~out[row]
        others = map_real(lambda row: excluded_by(row) & (places != row), take[None], row[None])[0]
        return out | others, (take, others)

    order = jnp.argsort(-score, stable=True)
    _, (taken, others) = jax.lax.scan(step, none, order)
    return none.at[order].set(taken), jnp.zeros((len(score), len(score)), dtype=bool).at[order].set(others)


def _shares_in_box(T_other_own: Float[Array, "s 4 4"], points: Points, margin: Scalar) -> Float[Array, " s"]:
    """Return which share of the points of one part lies in the other's box: the others are neither in nor on it."""
    return jax.vmap(lambda pose: _in_box(transform_points(pose, points), points, margin).mean())(T_other_own)


def _in_box(seen: Float[Array, "q 3"], points: Points, margin: Scalar | float) -> Bool[Array, " q"]:
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    return ((seen >= low[None]) & (seen <= high[None])).all(axis=1)


def overlap(pose: Pose, other: Pose, points: Points, normals: Normals, spacing: Scalar, depth: Scalar) -> Scalar:
    """Return which share of the points of one part is in or on the other, the larger of the two.

    Points deeper than `depth` below the other's surface, within its hull, are in it; nearer ones with a normal like its
    own are on it. `spacing` is how far the points are apart.
    """

    def share(pose: Pose, other: Pose) -> Scalar:
        return share_inside(compose(inverse(other), pose), (points, normals), (points, normals), spacing, depth)

    return jnp.maximum(share(pose, other), share(other, pose))


def share_inside(
    T_other_own: Pose, own: tuple[Points, Normals], other: tuple[Points, Normals], spacing: Scalar, depth: Scalar
) -> Scalar:
    """Return which share of the points of one part is in or on another one; see `overlap`.

    Pairs are in columns of one's own points: down them, CPUs find minima many points at a time.
    """
    points, normals = other
    highest = jax.lax.Precision.HIGHEST
    along = jnp.matmul(normals, points.T, precision=highest)
    offsets = jnp.diagonal(along)[:, None]
    seen = transform_points(T_other_own, own[0])
    away = jnp.sqrt(squared_distances(points, seen))
    row, nearest = first_smallest(away)
    heights = jnp.matmul(normals, seen.T, precision=highest) - offsets
    # Beyond an edge a point is below one face, but not below all that are about as near.
    height = jnp.where(away <= nearest[None] + spacing, heights, -jnp.inf).max(axis=0)
    # Where points are sparse, those about as near may all be turned away; outside of the hull nothing is inside.
    in_hull = _in_box(seen, points, 0.0) & (heights <= along.max(axis=1)[:, None] - offsets).all(axis=0)
    turned = jnp.matmul(own[1], T_other_own[:3, :3].T, precision=highest)
    alike = (turned * normals[row]).sum(axis=1) > _ALIKE  # where parts touch, they are opposite
    flush = jnp.abs(heights[row, jnp.arange(len(row))]) <= depth
    on = flush & (nearest <= depth + spacing) & alike
    return ((in_hull & (height < -depth)) | on).mean()


select_poses = kept("contest", results=(Selection,))(select)
