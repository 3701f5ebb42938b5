"""The poses of the copy in the middle of one crop, from points to refined poses: the one way in which poses are made.

The network sees several draws of the crop's points, as another draw often succeeds where one fails, but no more once
the measured surface confirms a pose well enough. Of all poses that the matches of a draw agree on, those that it
confirms best are refined.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from kmn_jax.detection._draw import (
    CropSearchConfig,
    Prediction,
    draw_of_crop,
    flat,
    poses_of_draw,
    predict,
    refined,
    surface_scores,
)
from kmn_jax.detection._mapping import map_rows
from kmn_jax.geometry import Crop, PaddedCloud, crop_around, transform_points
from kmn_jax.models import KeyMatchNet
from kmn_jax.objects import PartArrays
from kmn_jax.pose import PoseResult
from kmn_jax.programs import kept
from kmn_jax.typing import PRNGKey, Scalar

_LEAST_POINTS = 16  # a crop of fewer is not valid
_COMPARED = 32  # points of the surface by which poses are told apart

_Draws = TypeVar("_Draws")


class DrawsSearch(NamedTuple):
    """What the draws that were made say and find; those that were not have no points, and no pose."""

    num_draws: Int[Array, ""]  # that were made
    predictions: Prediction  # of d draws
    poses: PoseResult  # (d, h, ...), relative to the crop's seed
    scores: Float[Array, "d h"]  # see `surface_scores`, by the points of their draw and of those before: more, later on


class CropPoses(NamedTuple):
    """The poses of a crop, the one that the surface confirms best first, in the frame of its cloud."""

    poses: PoseResult  # (h, ...); inliers are matches of the draw that a pose is from
    scores: Float[Array, " h"]  # see `surface_scores`; minus infinity where there is no pose
    prediction: Prediction  # for the draw of the first pose
    seed: Float[Array, "3"]
    valid: Bool[Array, ""]  # whether there are enough points around the seed


def search_crop(
    cloud: PaddedCloud, seed_row: Int[ArrayLike, ""], diameter: Scalar, key: PRNGKey, config: CropSearchConfig
) -> Crop:
    """Return the crop of a cloud, around the point in a row, as `poses_in_crop` takes it."""
    num_points = config.points_of_draw
    count = max(config.most_draws * (num_points - 1) + 1, config.crop_points)
    return crop_around(key, cloud, jnp.asarray(seed_row), diameter, count, min(_LEAST_POINTS, num_points))


def poses_in_crop(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    crop: Crop,
    key: PRNGKey,
    config: CropSearchConfig,
) -> CropPoses:
    """Return the poses of the copy that shows a crop's seed, at most one of them right.

    A pure function: where it is called alone, it is `find_poses_in_crop`. The same inputs and key give the same bits
    on one device.
    """
    search = search_draws(nnx.merge(graphdef, parameters), part, crop, key, config)
    scores = search.scores.reshape(-1)
    found: PoseResult = jax.tree.map(flat, search.poses)
    rows, scores = _distinct(found.T_scene_object, scores, part, config)
    found = jax.tree.map(lambda leaf: leaf[rows], found)
    draws = rows // config.num_modes
    there = found.converged & jnp.isfinite(scores)

    def finished(found: PoseResult, draw: Int[Array, ""], there: Bool[Array, ""]) -> Float[Array, "4 4"]:
        def moved() -> Float[Array, "4 4"]:
            pose = found.T_scene_object
            if config.icp is not None:
                prediction: Prediction = jax.tree.map(lambda leaf: leaf[draw], search.predictions)
                pose = refined(pose, prediction, part, config)
            return pose.at[:3, 3].add(crop.seed)

        return jax.lax.cond(there, moved, lambda: jnp.eye(4, dtype=jnp.float32))

    poses = map_rows(finished, found, draws, there)
    return CropPoses(
        found._replace(T_scene_object=poses, converged=there),
        jnp.where(there, scores, -jnp.inf),
        jax.tree.map(lambda leaf: leaf[draws[0]], search.predictions),
        crop.seed,
        crop.valid,
    )


def search_draws(
    network: KeyMatchNet, part: PartArrays, crop: Crop, key: PRNGKey, config: CropSearchConfig
) -> DrawsSearch:
    """Make draws of a crop's points, until a pose is confirmed well enough by the points of those so far.

    One after the other, or, as on accelerators, all side by side: that takes little longer than one there, and nothing
    waits for a score. Those that would not have been made are forgotten.
    """
    keys = jax.random.split(key, config.most_draws)

    def one(draw: Int[Array, ""]) -> tuple[Prediction, PoseResult]:
        prediction = predict(network, part, draw_of_crop(crop, draw, part.diameter, config))
        return prediction, poses_of_draw(prediction, crop.valid, part, keys[draw], config)

    def scored(found: PoseResult, predictions: Prediction) -> Float[Array, " h"]:
        return surface_scores(found, predictions, crop.seed, part, config)

    at_once = jax.default_backend() != "cpu" if config.side_by_side is None else config.side_by_side
    return (draws_side_by_side if at_once else draws_in_turn)(one, scored, crop.valid, config)


def draws_in_turn(
    one: Callable[[Int[Array, ""]], tuple[Prediction, PoseResult]],
    scored: Callable[[PoseResult, Prediction], Float[Array, " h"]],
    valid: Bool[Array, ""],
    config: CropSearchConfig,
) -> DrawsSearch:
    """Make draws one after the other, given what makes one and what scores its poses by the draws so far.

    Under `vmap` each draw would be compared with in all of its ways: then make them side by side.
    """

    def more(state: DrawsSearch) -> Bool[Array, ""]:
        wanted = valid & (state.num_draws < config.most_draws) & is_unsure(state.scores.max(), config)
        return (state.num_draws == 0) | wanted

    def scored_by(count: int) -> Callable[[PoseResult, Prediction], Float[Array, " h"]]:
        return lambda found, made: scored(found, jax.tree.map(lambda leaf: leaf[:count], made))

    def make(state: DrawsSearch) -> DrawsSearch:
        draw, new = state.num_draws, one(state.num_draws)
        made: Any = jax.tree.map(lambda leaf, new: leaf.at[draw].set(new), (state.predictions, state.poses), new)
        # Draws that are still to be made have no points, but would take as long to compare with.
        scores = jax.lax.switch(draw, [scored_by(1 + row) for row in range(config.most_draws)], new[1], made[0])
        return DrawsSearch(draw + 1, made[0], made[1], state.scores.at[draw].set(scores))

    def none(leaf: jax.ShapeDtypeStruct) -> Array:
        return jnp.zeros((config.most_draws, *leaf.shape), leaf.dtype)

    nothing: Any = jax.tree.map(none, jax.eval_shape(one, jnp.int32(0)))
    scores = jnp.full((config.most_draws, config.num_modes), -jnp.inf, dtype=jnp.float32)
    return jax.lax.while_loop(more, make, DrawsSearch(jnp.int32(0), nothing[0], nothing[1], scores))


def draws_side_by_side(
    one: Callable[[Int[Array, ""]], tuple[Prediction, PoseResult]],
    scored: Callable[[PoseResult, Prediction], Float[Array, " h"]],
    valid: Bool[Array, ""],
    config: CropSearchConfig,
) -> DrawsSearch:
    """Make all draws at once, and return what `draws_in_turn` does, up to rounding."""
    draws = jnp.arange(config.most_draws, dtype=jnp.int32)
    predictions, poses = jax.vmap(one)(draws)
    scores = jax.vmap(lambda draw, found: scored(found, _first(predictions, draw + 1)))(draws, poses)
    number = draws_needed(scores, valid, config)
    kept = jnp.where((draws < number)[:, None], scores, -jnp.inf)
    return DrawsSearch(number, _first(predictions, number), _first(poses, number), kept)


def draws_needed(scores: Float[Array, "d h"], valid: Bool[Array, ""], config: CropSearchConfig) -> Int[Array, ""]:
    """Return how many draws of such scores are made one after the other."""
    unsure = jax.lax.cummin(is_unsure(jax.lax.cummax(scores.max(axis=1)), config).astype(jnp.int32))
    number = jnp.minimum(unsure.sum(dtype=jnp.int32) + 1, config.most_draws)
    return jnp.where(valid, number, 1)


def is_unsure(best: Float[Array, "*d"], config: CropSearchConfig) -> Bool[Array, "*d"]:
    """Tell whether more draws are wanted after some of which the best pose has this score, minus infinity of none."""
    unsure = best < (jnp.inf if config.enough is None else config.enough)
    return unsure & (best > -jnp.inf) if config.give_up else unsure


def _first(draws: _Draws, number: Int[Array, ""]) -> _Draws:
    """Return so many draws, with zeros in place of the others."""

    def kept(leaf: Array) -> Array:
        there = jnp.arange(leaf.shape[0]) < number
        return jnp.where(there.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, jnp.zeros((), leaf.dtype))

    result: _Draws = jax.tree.map(kept, draws)
    return result


def _distinct(
    poses: Float[Array, "p 4 4"], scores: Float[Array, " p"], part: PartArrays, config: CropSearchConfig
) -> tuple[Int[Array, " h"], Float[Array, " h"]]:
    """Return rows of the best poses that differ, and their scores: minus infinity where there are no more."""
    surface = jax.vmap(transform_points, in_axes=(0, None))(poses, part.points[:_COMPARED])
    apart = jax.vmap(lambda one: jnp.sqrt(((surface - one[None]) ** 2).sum(axis=2)).max(axis=1))(surface)

    def best(left: Float[Array, " p"], _: None) -> tuple[Float[Array, " p"], tuple[Int[Array, ""], Scalar]]:
        row = jnp.argmax(left)
        return jnp.where(apart[row] <= config.distinct * part.diameter, -jnp.inf, left), (row, left[row])

    _, (rows, scores) = jax.lax.scan(best, scores, length=config.num_poses)
    return rows, scores


crop_of_scene = kept("config", results=(Crop,))(search_crop)
find_poses_in_crop = kept("graphdef", "config", results=(CropPoses, PoseResult, Prediction))(poses_in_crop)
