"""The poses of the copy in the middle of one crop, from points to refined poses: the one way in which poses are made.

The network sees several draws of the crop's points, as another draw often succeeds where one fails, but no more once
the measured surface confirms a pose well enough. Of all poses that the matches of a draw agree on, those that it
confirms best are refined.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from kmn_jax.detection._mapping import map_rows
from kmn_jax.errors import InputError
from kmn_jax.geometry import (
    Crop,
    PaddedCloud,
    SmoothConfig,
    crop_around,
    even_rows,
    spread_rows,
    transform_points,
    with_normals,
)
from kmn_jax.models import KeyMatchNet, KeyMatchNetConfig
from kmn_jax.objects import PartArrays
from kmn_jax.pose import (
    IcpConfig,
    MatchConfig,
    Matches,
    PoseResult,
    RansacConfig,
    SurfaceConfig,
    find_matches,
    icp,
    ransac_modes,
    surface_agreement,
)
from kmn_jax.programs import kept
from kmn_jax.typing import PRNGKey, Scalar

_NORMAL_RADIUS = 0.06  # diameters, of normals without smoothing
_LEAST_POINTS = 16  # a crop of fewer is not valid
_LEAST_DRAWN = 1024  # points of a draw, ...
_MOST_DRAWS = 4  # ... around a place that is given
_COMPARED = 32  # points of the surface by which poses are told apart

_Draws = TypeVar("_Draws")


@dataclass(frozen=True)
class CropSearchConfig:
    """How poses are found in a crop; lengths are shares of the object's diameter."""

    num_draws: int | None = None  # of points that the network sees, at most; 4 unless given, see `of_network`
    enough: float | None = 0.7  # of a pose's surface score, -1 to 3: then no more draws are made; None: all are made
    give_up: bool = False  # no more draws where the first one has no pose: a few copies fewer, in turn far less time
    side_by_side: bool | None = None  # all draws at once; None: unless JAX runs on a CPU
    num_modes: int = 4  # poses of each draw that are compared with the surface
    num_poses: int = 3  # that are refined and returned: the best ones that differ
    distinct: float = 0.1  # how far apart, somewhere on the surface, poses differ
    num_points: int | None = None  # of a draw; by the network unless given, see `of_network`
    crop_points: int = 4096  # of the crop at least, from which normals are estimated
    smooth: SmoothConfig | None = field(default_factory=SmoothConfig)
    matches: MatchConfig = field(default_factory=lambda: MatchConfig(capacity=1024, least_points=40))
    ransac: RansacConfig = field(
        default_factory=lambda: RansacConfig(num_hypotheses=500, num_candidates=8192, normal_gate_degrees=60.0)
    )
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    surface_points: int = 128  # on the object
    icp: IcpConfig | None = field(default_factory=lambda: IcpConfig(iterations=8))  # None: poses stay as found
    icp_points: int = 256  # of a draw, on the object

    def __post_init__(self) -> None:
        for name in ("num_draws", "num_modes", "num_poses", "surface_points", "icp_points"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)} must be 1 or more")
        if self.enough is not None and not abs(self.enough) < float("inf"):
            raise InputError(f"enough = {self.enough} must be finite; None makes all draws")

    def of_network(self, config: KeyMatchNetConfig) -> CropSearchConfig:
        """Return the same with the numbers of draws and of their points, unless they are given.

        A draw has as many points as the network was trained with, or more: one of 512 finds more in 1,024
        (experiments/RESULTS.md). All over a scene draws are fewer and smaller, see `SearchConfig.of_network`.
        """
        num_points = self.num_points or max(config.num_scene_points, _LEAST_DRAWN)
        return replace(self, num_points=num_points, num_draws=self.num_draws or _MOST_DRAWS)

    @property
    def most_draws(self) -> int:
        """How many draws there are at most. Raises InputError if it is not known, see `of_network`."""
        if self.num_draws is None:
            raise InputError("num_draws is not given: take the config's of_network(model.config)")
        return self.num_draws

    @property
    def points_of_draw(self) -> int:
        """How many points a draw has. Raises InputError if it is not known, see `of_network`."""
        if self.num_points is None:
            raise InputError("num_points is not given: take the config's of_network(model.config)")
        return self.num_points


class Draw(NamedTuple):
    """Some of a crop's points, the seed first, smoothed; with their normals, towards the camera."""

    points: Float[Array, "n 3"]  # relative to the crop's seed as it was measured
    normals: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


class Prediction(NamedTuple):
    """What the network says of the n points of a draw; with a leading axis, of several draws."""

    points: Float[Array, "*d n 3"]  # relative to the crop's seed
    normals: Float[Array, "*d n 3"]
    mask: Bool[Array, "*d n"]
    segmentation: Float[Array, "*d n 2"]
    logits: Float[Array, "*d n k"]

    @property
    def on_object(self) -> Bool[Array, "*d n"]:
        """Which points are taken for the seed's copy."""
        return self.mask & (self.segmentation[..., 1] > self.segmentation[..., 0])


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
    found: PoseResult = jax.tree.map(_flat, search.poses)
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

        return jax.lax.cond(there, moved, lambda: jnp.eye(4))

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
    scores = jnp.full((config.most_draws, config.num_modes), -jnp.inf)
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


def draw_of_crop(crop: Crop, draw: Int[ArrayLike, ""], diameter: Scalar, config: CropSearchConfig) -> Draw:
    """Return one draw of a crop, evenly over its points.

    Draws share only the seed, unless the points are too few for that: each gets as many as it has room for.
    """
    others = config.points_of_draw - 1
    slots = max(config.most_draws * others, 1)  # of all draws, which lie evenly over the points
    total = jnp.maximum(crop.mask.sum(dtype=jnp.int32) - 1, others)
    slot = jnp.arange(others, dtype=jnp.int32) * config.most_draws + jnp.asarray(draw, dtype=jnp.int32)
    rows = jnp.concatenate([jnp.zeros(1, jnp.int32), 1 + even_rows(slot, total, slots)])
    mask = crop.mask[rows]
    points = jnp.where(mask[:, None], crop.points[rows], 0)
    points, normals = with_normals(
        points, mask, crop.points, crop.mask, -crop.seed, diameter, _NORMAL_RADIUS, config.smooth
    )
    return Draw(points, normals, mask)


def predict(network: KeyMatchNet, part: PartArrays, draw: Draw) -> Prediction:
    """Return what the network says of a draw."""
    points = jnp.where(draw.mask[:, None], draw.points - draw.points[:1], 0)  # as it sees them: from the seed's place
    features = network.encode_scene(jnp.concatenate([points, draw.normals], axis=1), part.diameter, draw.mask)
    return Prediction(*draw, *network.match(features, part.features, draw.mask))


def matches_of(prediction: Prediction, part: PartArrays, config: MatchConfig) -> Matches:
    """Return the matches of a draw, relative to the crop's seed."""
    count = part.features.shape[0]
    return find_matches(
        prediction.segmentation,
        prediction.logits,
        prediction.points,
        prediction.normals,
        part.points[:count],
        part.normals[:count],
        part.diameter,
        prediction.mask,
        config,
    )


def poses_of_draw(
    prediction: Prediction, valid: Bool[Array, ""], part: PartArrays, key: PRNGKey, config: CropSearchConfig
) -> PoseResult:
    """Return the poses that the matches of a draw agree on, (h, ...), relative to the crop's seed."""
    matches = matches_of(prediction, part, config.matches)
    return ransac_modes(key, matches._replace(mask=matches.mask & valid), config.num_modes, config.ransac)


def surface_scores(
    poses: PoseResult, predictions: Prediction, seed: Float[Array, "3"], part: PartArrays, config: CropSearchConfig
) -> Float[Array, " p"]:
    """Return how well the points of all draws that were made confirm each pose; minus infinity where there is none.

    A score is that of `surface_agreement` and the share of matches that agree, -1 to 3 in sum.
    """
    surface = part.points[: config.surface_points], part.normals[: config.surface_points]
    draws = predictions.points, predictions.normals, predictions.mask, predictions.on_object
    points, normals, mask, taken = map(_flat, draws)

    def one(pose: PoseResult) -> Scalar:
        def compared() -> Scalar:
            agreement = surface_agreement(
                pose.T_scene_object, *surface, points, normals, mask, taken, -seed, part.diameter, config.surface
            )
            return agreement.score + pose.score

        return jax.lax.cond(pose.converged, compared, lambda: jnp.float32(-jnp.inf))

    return map_rows(one, poses)


def refined(
    pose: Float[Array, "4 4"], prediction: Prediction, part: PartArrays, config: CropSearchConfig
) -> Float[Array, "4 4"]:
    """Return a pose moved onto the points of a draw that are taken for the object."""
    rows, real = spread_rows(prediction.on_object, config.icp_points)
    assert config.icp is not None
    fine = icp(
        part.points,
        prediction.points[rows],
        pose,
        part.diameter,
        scene_normals=prediction.normals[rows],
        scene_mask=real,
        config=config.icp,
    )
    return fine.T_scene_object


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


def _flat(leaf: Shaped[Array, "d n ..."]) -> Shaped[Array, "m ..."]:
    return leaf.reshape(-1, *leaf.shape[2:])


crop_of_scene = kept("config", results=(Crop,))(search_crop)
find_poses_in_crop = kept("graphdef", "config", results=(CropPoses, PoseResult, Prediction))(poses_in_crop)
