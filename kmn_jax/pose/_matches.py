"""From the network's logits to point pairs that vote for a pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import log
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import (
    InputError,
    check_type,
    float_array,
    is_traced,
    mask_array,
    point_array,
    positive_scalar,
    require,
)
from kmn_jax.geometry import largest
from kmn_jax.typing import ArrayInput, Normals, Points, Scalar

OBJECT_CLASS = 1  # segmentation logits are (background, object)


class Matches(NamedTuple):
    """Pairs of an object point and the scene point that may show it, in a fixed capacity c (batched by vmap).

    Object points and normals are in the object's frame, scene ones in the scene's, both in the same unit.
    """

    object_points: jax.Array  # (c, 3)
    object_normals: jax.Array  # (c, 3), unit, outwards
    scene_points: jax.Array  # (c, 3)
    scene_normals: jax.Array  # (c, 3), unit, towards the camera
    weights: jax.Array  # (c,), >= 0, trust in the match, used when a pose is fitted to inliers
    mask: jax.Array  # (c,), bool, false = padding
    overflow: jax.Array  # (), bool, true if the capacity did not hold all matches
    object_diameter: jax.Array  # (), largest extent of the object: the length that gates are fractions of


@dataclass(frozen=True)
class MatchConfig:
    """Choose which scores become matches. Vote threshold as published (arXiv 2303.16102, pose estimation)."""

    vote_threshold: float = 0.7  # a point votes for each keypoint that scores this share of its best one
    softmax: Literal["keypoints", "points"] = "keypoints"  # along which scores are 1 in sum; the authors' code: points
    capacity: int = 4096  # matches kept at most, the most trusted ones
    least_points: int = 0  # so many points vote at least, those that are most like the object; published: 0

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        require(0 < self.vote_threshold <= 1, f"vote_threshold is {self.vote_threshold}, but must be in (0, 1]")
        require(
            self.softmax in ("keypoints", "points"), f"softmax is {self.softmax!r}, but must be 'keypoints' or 'points'"
        )
        require(self.capacity >= 3, f"capacity is {self.capacity}, but a pose needs at least 3 matches")
        require(self.least_points >= 0, f"least_points is {self.least_points}, but must be 0 or more")


def find_matches(
    segmentation_logits: ArrayInput,
    keypoint_logits: ArrayInput,
    scene_points: ArrayInput,
    scene_normals: ArrayInput,
    keypoints: ArrayInput,
    keypoint_normals: ArrayInput,
    object_diameter: ArrayInput,
    mask: ArrayInput | None = None,
    config: MatchConfig = MatchConfig(),
) -> Matches:
    """Return the matches that segmentation logits (n, 2) and keypoint logits (n, k) vote for.

    A scene point whose object logit (column 1) exceeds its background logit (column 0) is matched with every
    keypoint (k, 3) whose softmax score over the keypoints is at least `vote_threshold` times its best one (the paper's
    rule; with `softmax` "points", scores are those over the points, as in the authors' code). The weight of a match is
    that score times the softmax score of the object class. If fewer than `least_points` are the object's, so many vote
    in all: those whose object logits exceed the others by most. Points where `mask` (n,) is false never vote; neither
    do, under a trace, points with values that are not finite, for which outside of one InputError is raised, as it is
    for wrong shapes and dtypes. No vote at all is a mask without a true.
    """
    check_type(config, MatchConfig, "config")
    keypoint_logits = float_array(keypoint_logits, "keypoint_logits", (None, None), finite=False)
    n, k = keypoint_logits.shape
    if 0 in (n, k):
        raise InputError(f"keypoint_logits has shape {(n, k)}, but must be (points, keypoints), both at least 1")
    real = mask_array(mask, "mask", n)
    rows = None if is_traced(real) else real
    diameter = positive_scalar(object_diameter, "object_diameter")
    arrays = (
        float_array(segmentation_logits, "segmentation_logits", (n, 2), mask=rows),
        float_array(keypoint_logits, "keypoint_logits", (n, k), mask=rows),
        point_array(scene_points, "scene_points", n, mask=rows, size=diameter),
        float_array(scene_normals, "scene_normals", (n, 3), mask=rows),
        point_array(keypoints, "keypoints", k, size=diameter),
        float_array(keypoint_normals, "keypoint_normals", (k, 3)),
        diameter,
    )
    return _find_matches(*(array.astype(jnp.float32) for array in arrays), real, config)


@partial(jax.jit, static_argnames="config")
def _find_matches(
    segmentation_logits: Float[Array, "n 2"],
    keypoint_logits: Float[Array, "n k"],
    scene_points: Points,
    scene_normals: Normals,
    keypoints: Float[Array, "k 3"],
    keypoint_normals: Float[Array, "k 3"],
    object_diameter: Scalar,
    mask: Bool[Array, " n"],
    config: MatchConfig,
) -> Matches:
    n, k = keypoint_logits.shape
    for array in (segmentation_logits, keypoint_logits, scene_points, scene_normals):
        mask = mask & jnp.isfinite(array).all(axis=1)
    segmentation_logits = jnp.where(mask[:, None], segmentation_logits, 0)
    keypoint_logits = jnp.where(mask[:, None], keypoint_logits, 0)

    margins = segmentation_logits[:, OBJECT_CLASS] - segmentation_logits[:, 1 - OBJECT_CLASS]
    is_object = margins > 0
    if config.least_points:
        likest, _ = largest(jnp.where(mask, margins, -jnp.inf), min(config.least_points, n))
        is_object = is_object | (margins >= likest.min())
    if config.softmax == "points":
        keypoint_logits = jax.nn.log_softmax(jnp.where(mask[:, None], keypoint_logits, -jnp.inf), axis=0)
        keypoint_logits = jnp.where(mask[:, None], keypoint_logits, 0)
        keypoint_scores = jnp.exp(keypoint_logits)
    else:
        keypoint_scores = jax.nn.softmax(keypoint_logits, axis=1)
    # A ratio of softmax scores is a difference of logits.
    votes = keypoint_logits >= keypoint_logits.max(axis=1, keepdims=True) + log(config.vote_threshold)
    votes = votes & (mask & is_object)[:, None]
    scores = jax.nn.softmax(segmentation_logits, axis=1)[:, OBJECT_CLASS, None] * keypoint_scores

    size = min(config.capacity, n * k)
    weights, flat = largest(jnp.where(votes, scores, -1).reshape(-1), size)
    kept = weights >= 0
    point, keypoint = flat // k, flat % k
    padding = (0, config.capacity - size)

    def gather(rows: Float[Array, "r 3"], index: jax.Array) -> Float[Array, "c 3"]:
        return jnp.pad(jnp.where(kept[:, None], rows[index], 0), (padding, (0, 0)))

    return Matches(
        object_points=gather(keypoints, keypoint),
        object_normals=gather(keypoint_normals, keypoint),
        scene_points=gather(scene_points, point),
        scene_normals=gather(scene_normals, point),
        weights=jnp.pad(jnp.where(kept, weights, 0), padding),
        mask=jnp.pad(kept, padding),
        overflow=votes.sum(dtype=jnp.int32) > config.capacity,
        object_diameter=object_diameter,
    )
