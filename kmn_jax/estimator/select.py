"""Which hypotheses stand together: one pose an instance, and no two parts in one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from kmn_jax.data.symmetry import Symmetries
from kmn_jax.estimator.part import Part
from kmn_jax.geometry import compose, inverse, nearest, transform_points
from kmn_jax.pose import discretise_symmetry, mssd
from kmn_jax.typing import Normals, Points, Scalar

_LEAST_PAIRS = 256  # the smallest number that is compiled
_ALIKE = 0.5  # cosine of normals
_TURNS = 36  # of a continuous symmetry: 10 degrees, under which poses count as the same anyway


@dataclass(frozen=True)
class SelectConfig:
    """Set the selection; lengths are shares of the object's diameter."""

    same_pose: float = 0.2  # poses whose surfaces are nowhere further apart are one
    depth: float = 0.05  # a point so far below another part's surface is inside of it
    overlap: float = 0.15  # share of a part's points that may be inside of another part, or on the same surface
    contest: float = 0.2  # difference of scores up to which another pose may turn out to be better
    num_points: int = 256  # on the surface, that are compared


def symmetry_transforms(symmetries: Symmetries) -> Float[np.ndarray, "t 4 4"]:
    """Return all poses `T_object_object` under which the object looks the same, continuous ones in steps."""
    result = symmetries.transforms
    for axis in symmetries.axes:
        turns = np.asarray(discretise_symmetry(axis.astype(np.float32), symmetries.center.astype(np.float32), _TURNS))
        result = np.einsum("tij,sjk->tsik", turns.astype(float), result).reshape(-1, 4, 4)
    return result.astype(np.float32)


class Relations(NamedTuple):
    """How the parts of p pairs of poses lie to each other."""

    distance: Float[Array, " p"]  # of the two poses: MSSD, symmetries forgiven
    overlap: Float[Array, " p"]  # share of the points of one that is in or on the other, the larger of the two


@jax.jit
def relations(
    pairs: Float[Array, "p 2 4 4"],
    points: Points,
    normals: Normals,
    symmetries: Float[Array, "t 4 4"],
    depth: Scalar,
) -> Relations:
    """Compare pairs of poses by points of the part's surface; `depth` is how far below a surface inside is."""

    def share(pose: Float[Array, "4 4"], other: Float[Array, "4 4"]) -> Scalar:
        between = compose(inverse(other), pose)
        seen = transform_points(between, points)
        row, distance = nearest(seen, points)
        below = ((seen - points[row]) * normals[row]).sum(axis=1) < -depth
        turned = jnp.matmul(normals, between[:3, :3].T, precision=jax.lax.Precision.HIGHEST)
        alike = (turned * normals[row]).sum(axis=1) > _ALIKE  # where parts touch, they are opposite
        return (below | ((distance <= depth) & alike)).mean()

    def of(pair: Float[Array, "2 4 4"]) -> Relations:
        one, other = pair
        return Relations(mssd(one, other, points, symmetries), jnp.maximum(share(one, other), share(other, one)))

    return jax.lax.map(of, pairs)


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
    contenders: Bool[np.ndarray, " s"]  # other poses for the places of what is kept, that score nearly as high


def select(
    poses: Float32[np.ndarray, "s 4 4"],
    score: Float[np.ndarray, " s"],
    usable: Bool[np.ndarray, " s"],
    part: Part,
    config: SelectConfig,
) -> Selection:
    """Choose among hypotheses with scores of zero and above."""
    points, normals = part.points[: config.num_points], part.normals[: config.num_points]
    middle = np.append((part.minimum + part.maximum) / 2, 1)
    centers = (poses @ middle)[:, :3]
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    reach = float(np.linalg.norm(part.maximum - part.minimum))  # parts further apart do not touch
    first, second = np.nonzero(np.triu((apart < reach) & usable[:, None] & usable[None], 1))
    same, clash = np.zeros((2, len(poses), len(poses)), dtype=bool)
    if len(first):
        slots = max(_LEAST_PAIRS, 1 << (len(first) - 1).bit_length())  # few sizes are compiled
        pairs = np.tile(np.eye(4, dtype=np.float32), (slots, 2, 1, 1))
        pairs[: len(first), 0], pairs[: len(first), 1] = poses[first], poses[second]
        transforms = symmetry_transforms(part.symmetries)
        spare = (1 << (len(transforms) - 1).bit_length()) - len(transforms)
        transforms = np.concatenate([transforms, np.tile(np.eye(4, dtype=np.float32), (spare, 1, 1))])
        depth = jnp.float32(config.depth * part.diameter)
        found: Any = jax.device_get(
            relations(jnp.asarray(pairs), jnp.asarray(points), jnp.asarray(normals), jnp.asarray(transforms), depth)
        )
        same[first, second] = (found.distance <= config.same_pose * part.diameter)[: len(first)]
        clash[first, second] = (found.overlap > config.overlap)[: len(first)]
    same, clash = same | same.T, clash | clash.T
    kept = accept(score, usable, same | clash)
    # A pose that a better one has ruled out elsewhere is no rival here.
    better = kept[:, None] & (same | clash) & (score[:, None] > score[None])
    alone = better.sum(axis=0)[None] == better
    rivals = clash & usable[None] & ~kept[None] & alone
    gap = score - np.where(rivals, score[None], 0).max(axis=1, initial=0)
    close = (kept[:, None] & clash & (score[:, None] - score[None] <= config.contest)).any(axis=0)
    distinct = usable & close & ~kept & ~(same & kept[:, None]).any(axis=0)
    return Selection(kept, gap, accept(score, distinct, same))
