"""The pose of the copy in the middle of one crop, from points to pose.

Compiled in two: what takes the crop out of the scene, for every capacity of scenes, and all that follows, once.

The network sees several draws of the crop's points, as another draw often succeeds where one fails, but no more once
the measured surface confirms a pose well enough. Of all poses that the matches of a draw agree on, the one that it
confirms best is chosen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from math import isfinite
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from kmn_jax.data import Crop, CropConfig, camera_normals
from kmn_jax.detection._scan_crop import SceneArrays, even_rows, first_crop
from kmn_jax.geometry import SmoothConfig, normals_within_radius, smoothed
from kmn_jax.models import KeyMatchNet
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
from kmn_jax.typing import Pose, PRNGKey, Scalar


@dataclass(frozen=True)
class CropPoseConfig:
    """How a pose is found in a crop; lengths are shares of the object's diameter."""

    num_draws: int = 4  # of points that the network sees, at most
    enough: float | None = 0.7  # of `surface_scores`, -1 to 3: then no more draws are made; None: all are made
    num_modes: int = 4  # poses of each draw that are compared with the surface
    matches: MatchConfig = field(default_factory=lambda: MatchConfig(capacity=1024))
    ransac: RansacConfig = field(default_factory=lambda: RansacConfig(num_hypotheses=500, num_candidates=8192))
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    surface_points: int = 128  # on the object
    smooth: SmoothConfig | None = field(default_factory=SmoothConfig)
    normal_points: int = 4096  # of the crop at least, from which normals are estimated
    icp: IcpConfig | None = None  # refines the pose on the points of its draw

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if min(self.num_draws, self.num_modes, self.surface_points) < 1:
            raise ValueError(
                f"num_draws = {self.num_draws}, num_modes = {self.num_modes} and surface_points ="
                f" {self.surface_points} must be 1 or more"
            )
        if self.enough is not None and not isfinite(self.enough):
            raise ValueError(f"enough = {self.enough} must be finite; None makes all draws")


class Said(NamedTuple):
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


class Searched(NamedTuple):
    """What the draws that were made say and find; those that were not have no points, and no pose."""

    num_draws: Int[Array, ""]  # that were made
    said: Said  # of d draws
    poses: PoseResult  # (d, h, ...), relative to the crop's seed
    scores: Float[Array, "d h"]  # see `surface_scores`, by the points of their draw and of those before: more, later on


class Draw(NamedTuple):
    """Some of a crop's points, the seed first, smoothed; with their normals, towards the camera."""

    points: Float[Array, "n 3"]  # relative to the crop's seed as it was measured
    normals: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


def crop_for_draws(part: PartArrays, scene: SceneArrays, key: PRNGKey, num_points: int, config: CropPoseConfig) -> Crop:
    """Return the crop around a scene's first point as `crop_pose` takes it with the same key, without normals."""
    count = max(config.num_draws * (num_points - 1) + 1, config.normal_points)
    crops = CropConfig(num_points=count, normals="surface", max_noise=0.0, min_points=min(16, num_points))
    return _crop(scene, part.diameter, key, crops)


@partial(jax.jit, static_argnames="config")
def _crop(scene: SceneArrays, diameter: Scalar, key: PRNGKey, config: CropConfig) -> Crop:
    return first_crop(scene, diameter, _crop_key(key), config)


def draw_of_crop(
    crop: Crop, draw: Int[ArrayLike, ""], diameter: Scalar, num_points: int, config: CropPoseConfig
) -> Draw:
    """Return one draw of a crop, evenly over its points.

    Draws share only the seed, unless the points are too few for that: each gets as many as it has room for.
    """
    others = num_points - 1
    slots = max(config.num_draws * others, 1)  # of all draws, which lie evenly over the points
    total = jnp.maximum(crop.mask.sum(dtype=jnp.int32) - 1, others)
    slot = jnp.arange(others, dtype=jnp.int32) * config.num_draws + jnp.asarray(draw, dtype=jnp.int32)
    rows = jnp.concatenate([jnp.zeros(1, jnp.int32), 1 + even_rows(slot, total, slots)])
    mask = crop.mask[rows]
    points = jnp.where(mask[:, None], crop.points[rows], 0)
    if config.smooth is None:
        normals, known = normals_within_radius(points, crop.points, CropConfig.normal_radius * diameter, crop.mask)
    else:
        points, normals, known, _ = smoothed(points, mask, crop.points, crop.mask, diameter, config.smooth)
    normals = camera_normals(points, normals, known, -crop.seed)
    return Draw(points, jnp.where(mask[:, None], normals, 0), mask)


def said_of_draw(network: KeyMatchNet, part: PartArrays, draw: Draw) -> Said:
    """Return what the network says of a draw."""
    points = jnp.where(draw.mask[:, None], draw.points - draw.points[:1], 0)  # as it sees them: from the seed's place
    features = network.encode_scene(jnp.concatenate([points, draw.normals], axis=1), part.diameter, draw.mask)
    return Said(*draw, *network.match(features, part.features, draw.mask))


def matches_of(said: Said, part: PartArrays, config: MatchConfig) -> Matches:
    """Return the matches of a draw, relative to the crop's seed."""
    count = part.features.shape[0]
    return find_matches(
        said.segmentation,
        said.logits,
        said.points,
        said.normals,
        part.points[:count],
        part.normals[:count],
        part.diameter,
        said.mask,
        config,
    )


def poses_of_draw(
    said: Said, valid: Bool[Array, ""], part: PartArrays, key: PRNGKey, config: CropPoseConfig
) -> PoseResult:
    """Return the poses that the matches of a draw agree on, (h, ...), relative to the crop's seed."""
    matches = matches_of(said, part, config.matches)
    return ransac_modes(key, matches._replace(mask=matches.mask & valid), config.num_modes, config.ransac)


def search_draws(
    network: KeyMatchNet, part: PartArrays, crop: Crop, key: PRNGKey, num_points: int, config: CropPoseConfig
) -> Searched:
    """Make draws of a crop's points, until a pose is confirmed well enough by the points of those so far."""
    keys = jax.random.split(_pose_key(key), config.num_draws)

    def one(draw: Int[Array, ""]) -> tuple[Said, PoseResult]:
        said = said_of_draw(network, part, draw_of_crop(crop, draw, part.diameter, num_points, config))
        return said, poses_of_draw(said, crop.valid, part, keys[draw], config)

    def more(state: Searched) -> Bool[Array, ""]:
        left = (state.num_draws < config.num_draws) & (crop.valid | (state.num_draws == 0))
        return left if config.enough is None else left & (state.scores.max() < config.enough)

    def make(state: Searched) -> Searched:
        draw = state.num_draws
        new_said, new_poses = one(draw)
        said = jax.tree.map(lambda leaf, new: leaf.at[draw].set(new), state.said, new_said)
        poses = jax.tree.map(lambda leaf, new: leaf.at[draw].set(new), state.poses, new_poses)
        scores = surface_scores(new_poses, said, crop.seed, part, config)
        return Searched(draw + 1, said, poses, state.scores.at[draw].set(scores))

    def none(leaf: jax.ShapeDtypeStruct) -> Array:
        return jnp.zeros((config.num_draws, *leaf.shape), leaf.dtype)

    said, poses = jax.tree.map(none, jax.eval_shape(one, jnp.int32(0)))
    scores = jnp.full((config.num_draws, config.num_modes), -jnp.inf)
    return jax.lax.while_loop(more, make, Searched(jnp.int32(0), said, poses, scores))


def surface_scores(
    poses: PoseResult, said: Said, seed: Float[Array, "3"], part: PartArrays, config: CropPoseConfig
) -> Float[Array, " p"]:
    """Return how well the points of all draws that were made confirm each pose; minus infinity where there is none.

    A score is that of `surface_agreement` and the share of matches that agree, -1 to 3 in sum.
    """
    surface, normals = part.points[: config.surface_points], part.normals[: config.surface_points]
    points, point_normals, mask, on_object = map(_flat, (said.points, said.normals, said.mask, said.on_object))

    def one(pose: PoseResult) -> Scalar:
        def compared() -> Scalar:
            seen = surface_agreement(
                pose.T_scene_object,
                surface,
                normals,
                points,
                point_normals,
                mask,
                on_object,
                -seed,
                part.diameter,
                config.surface,
            )
            return seen.score + pose.score

        return jax.lax.cond(pose.converged, compared, lambda: jnp.float32(-jnp.inf))

    return jax.lax.map(one, poses)


def crop_pose(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    scene: SceneArrays,
    key: PRNGKey,
    num_points: int,
    config: CropPoseConfig = CropPoseConfig(),
) -> PoseResult:
    """Return the pose of the copy that shows a scene's first point, in the scene's frame: the camera is its origin.

    What is farther from that point than a diameter is not used. `num_points` of a draw are as many as the network was
    made for. Inlier counts are those of the matches of the draw that the pose is from, its mask that draw's.
    """
    crop = crop_for_draws(part, scene, key, num_points, config)
    return _pose_in_crop(graphdef, parameters, part, crop, key, num_points, config)


@partial(jax.jit, static_argnames=("graphdef", "config", "num_points"))
def _pose_in_crop(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    crop: Crop,
    key: PRNGKey,
    num_points: int,
    config: CropPoseConfig,
) -> PoseResult:
    _, said, poses, scores = search_draws(nnx.merge(graphdef, parameters), part, crop, key, num_points, config)
    best, mode = jnp.unravel_index(jnp.argmax(scores), scores.shape)
    found: PoseResult = jax.tree.map(lambda leaf: leaf[best, mode], poses)
    if config.icp is not None:
        draw: Said = jax.tree.map(lambda leaf: leaf[best], said)
        found = found._replace(T_scene_object=refined(found, draw, part, config.icp))
    return found._replace(T_scene_object=found.T_scene_object.at[:3, 3].add(jnp.where(found.converged, crop.seed, 0)))


def refined(found: PoseResult, draw: Said, part: PartArrays, config: IcpConfig) -> Pose:
    """Return a pose moved onto the points of a draw; one that is none stays as it is."""

    def moved() -> Pose:
        fine = icp(
            part.points,
            draw.points,
            found.T_scene_object,
            part.diameter,
            scene_normals=draw.normals,
            scene_mask=draw.mask,
            config=config,
        )
        return fine.T_scene_object

    return jax.lax.cond(found.converged, moved, lambda: found.T_scene_object)


def _crop_key(key: PRNGKey) -> PRNGKey:
    return jax.random.split(key)[0]


def _pose_key(key: PRNGKey) -> PRNGKey:
    return jax.random.split(key)[1]


def _flat(leaf: Shaped[Array, "d n ..."]) -> Shaped[Array, "m ..."]:
    return leaf.reshape(-1, *leaf.shape[2:])
