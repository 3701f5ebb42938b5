"""Which hypotheses stand together: one pose an instance, and no two parts in one place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from kmn_jax.geometry import compose, inverse, squared_distances, transform_points
from kmn_jax.objects import Part, Symmetries
from kmn_jax.pose import discretise_symmetry, mssd
from kmn_jax.typing import Normals, Points, Pose, Scalar

_PAIRS = 64  # that are compared in one call: one number, so one compilation
_ALIKE = 0.5  # cosine of normals
_BREADTHS = 0.5  # of a part, between poses of one copy
_TURNS = 36  # of a continuous symmetry: 10 degrees, under which poses count as the same anyway


@dataclass(frozen=True)
class SelectConfig:
    """Set the selection; lengths are shares of the object's diameter."""

    same_pose: float = 0.2  # poses whose surfaces are nowhere further apart are one, see `same_place`
    depth: float = 0.05  # a point so far below another part's surface is inside of it
    overlap: float = 0.15  # share of a part's points that may be inside of another part, or on the same surface
    contest: float = 0.1  # difference of scores up to which another pose may turn out to be better
    num_points: int = 128  # on the surface, that are compared


def same_place(part: Part, config: SelectConfig) -> float:
    """Return how far apart poses of one copy may be: less than slender parts that lie side by side are."""
    breadth = float(np.sort(part.maximum - part.minimum)[1])
    return min(config.same_pose * part.diameter, _BREADTHS * breadth)


def symmetry_transforms(symmetries: Symmetries) -> Float[np.ndarray, "t 4 4"]:
    """Return all poses `T_object_object` under which the object looks the same, continuous ones in steps."""
    result = symmetries.transforms
    for axis in symmetries.axes:
        turns = np.asarray(discretise_symmetry(axis.astype(np.float32), symmetries.center.astype(np.float32), _TURNS))
        result = np.einsum("tij,sjk->tsik", turns.astype(float), result).reshape(-1, 4, 4)
    return result.astype(np.float32)


def padded_symmetries(part: Part) -> Float[Array, "t 4 4"]:
    """Return a part's symmetries in a number that is compiled, with the identity after them."""
    transforms = symmetry_transforms(part.symmetries)
    spare = (1 << (len(transforms) - 1).bit_length()) - len(transforms)
    return jnp.asarray(np.concatenate([transforms, np.tile(np.eye(4, dtype=np.float32), (spare, 1, 1))]))


@jax.jit
def distances(pairs: Float[Array, "p 2 4 4"], points: Points, symmetries: Float[Array, "t 4 4"]) -> Float[Array, " p"]:
    """Return the MSSD of pairs of poses: how far apart they hold a surface point at most, symmetries forgiven."""
    return jax.lax.map(lambda pair: mssd(pair[0], pair[1], points, symmetries), pairs)


def overlap(pose: Pose, other: Pose, points: Points, normals: Normals, spacing: Scalar, depth: Scalar) -> Scalar:
    """Return which share of the points of one part is in or on the other, the larger of the two.

    Points deeper than `depth` below the other's surface are in it; nearer ones with a normal like its own are on it.
    `spacing` is how far the points are apart.
    """

    offsets = (points * normals).sum(axis=1)

    def share(pose: Pose, other: Pose) -> Scalar:
        between = compose(inverse(other), pose)
        seen = transform_points(between, points)
        away = jnp.sqrt(squared_distances(seen, points))
        nearest = away.min(axis=1, keepdims=True)
        highest = jax.lax.Precision.HIGHEST
        heights = jnp.matmul(seen, normals.T, precision=highest) - offsets[None]
        # Beyond an edge a point is below one face, but not below all that are about as near.
        height = jnp.where(away <= nearest + spacing, heights, -jnp.inf).max(axis=1)
        row = jnp.argmin(away, axis=1)
        turned = jnp.matmul(normals, between[:3, :3].T, precision=highest)
        alike = (turned * normals[row]).sum(axis=1) > _ALIKE  # where parts touch, they are opposite
        flush = jnp.abs(heights[jnp.arange(len(row)), row]) <= depth
        on = flush & (nearest[:, 0] <= depth + spacing) & alike
        return ((height < -depth) | on).mean()

    return jnp.maximum(share(pose, other), share(other, pose))


@jax.jit
def overlaps(
    pairs: Float[Array, "p 2 4 4"], points: Points, normals: Normals, spacing: Scalar, depth: Scalar
) -> Float[Array, " p"]:
    """Return `overlap` of pairs of poses."""
    return jax.lax.map(lambda pair: overlap(pair[0], pair[1], points, normals, spacing, depth), pairs)


def accept(
    score: Float[np.ndarray, " s"], usable: Bool[np.ndarray, " s"], excluded: Bool[np.ndarray, "s s"]
) -> Bool[np.ndarray, " s"]:
    """Take hypotheses from the best score on, each unless one that was taken before excludes it.

    Equal scores go by their order.
    """
    taken = np.zeros(len(score), dtype=bool)
    for row in np.argsort(-score, kind="stable"):
        taken[row] = usable[row] and not (excluded[row] & taken).any()
    return taken


class Selection(NamedTuple):
    """Which hypotheses stand, and by how much each scores above the best other pose for its place."""

    kept: Bool[np.ndarray, " s"]
    gap: Float[np.ndarray, " s"]  # of what is kept; the score itself where nothing competes
    contenders: Bool[np.ndarray, " s"]  # the best other pose for the place of each that is kept, if nearly as good


def select(
    poses: Float32[np.ndarray, "s 4 4"],
    score: Float[np.ndarray, " s"],
    usable: Bool[np.ndarray, " s"],
    part: Part,
    config: SelectConfig,
) -> Selection:
    """Choose among hypotheses with scores of zero and above."""
    points, normals = (jnp.asarray(array[: config.num_points]) for array in (part.points, part.normals))
    centers = (poses @ np.append(part.points.mean(axis=0), 1))[:, :3]
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    reach = same_place(part, config)
    # The mean of the points moves no farther than the farthest of them.
    symmetries = padded_symmetries(part)
    same = _related(
        poses,
        (apart <= reach) & usable[:, None] & usable[None],
        lambda pairs: distances(pairs, points, symmetries) <= reach,
    )
    one_each = accept(score, usable, same)
    depth = jnp.float32(config.depth * part.diameter)
    spacing = jnp.float32(np.sqrt(part.area / len(points)))
    clash = _related(
        poses,
        (apart <= 2 * part.diameter) & one_each[:, None] & one_each[None],
        lambda pairs: overlaps(pairs, points, normals, spacing, depth) > config.overlap,
    )
    kept = accept(score, one_each, clash)
    # A pose that a better one has ruled out elsewhere is no rival here.
    better = kept[:, None] & clash & (score[:, None] > score[None])
    alone = better.sum(axis=0)[None] == better
    rivals = clash & (one_each & ~kept)[None] & alone
    gap = score - np.where(rivals, score[None], 0).max(axis=1, initial=0)
    contenders = np.zeros_like(kept)
    for row in np.flatnonzero(kept):
        others = np.where(clash[row] & one_each & ~kept, score, -np.inf)
        if others.max() >= score[row] - config.contest:
            contenders[others.argmax()] = True
    return Selection(kept, gap, contenders)


def _related(
    poses: Float32[np.ndarray, "s 4 4"],
    maybe: Bool[np.ndarray, "s s"],
    holds: Callable[[Float[Array, "p 2 4 4"]], Bool[Array, " p"]],
) -> Bool[np.ndarray, "s s"]:
    """Return for which pairs something symmetric holds, of those for which it may."""
    first, second = np.nonzero(np.triu(maybe, 1))
    result = np.zeros_like(maybe)
    for start in range(0, len(first), _PAIRS):
        one, other = first[start : start + _PAIRS], second[start : start + _PAIRS]
        pairs = np.tile(np.eye(4, dtype=np.float32), (_PAIRS, 2, 1, 1))
        pairs[: len(one), 0], pairs[: len(one), 1] = poses[one], poses[other]
        result[one, other] = np.asarray(holds(jnp.asarray(pairs)))[: len(one)]
    return result | result.T
