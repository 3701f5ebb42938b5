"""The pose of the copy in the middle of one crop, from points to pose in one compiled call.

The network sees several draws of the crop's points, as another draw often succeeds where one fails. Of all poses that
their matches agree on, the one that the measured surface confirms best is chosen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key, Shaped

from kmn_jax.data.crops import Crop, CropConfig, crop_around
from kmn_jax.data.smoothing import SmoothConfig
from kmn_jax.estimator.search import PartArrays, SceneArrays, as_visible
from kmn_jax.models import KeyMatchNet
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

    num_draws: int = 4  # of points that the network sees
    num_modes: int = 4  # poses of each draw that are compared with the surface
    matches: MatchConfig = field(default_factory=lambda: MatchConfig(capacity=1024))
    ransac: RansacConfig = field(default_factory=lambda: RansacConfig(num_hypotheses=500, num_candidates=8192))
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    surface_points: int = 128  # on the object
    smooth: SmoothConfig | None = field(default_factory=SmoothConfig)
    normal_points: int = 4096  # of the crop, from which normals are estimated
    icp: IcpConfig | None = None  # refines the pose on the points of its draw

    def __post_init__(self) -> None:
        """Refuse values that contradict their meaning."""
        if min(self.num_draws, self.num_modes, self.surface_points) < 1:
            raise ValueError(
                f"num_draws = {self.num_draws}, num_modes = {self.num_modes} and surface_points ="
                f" {self.surface_points} must be 1 or more"
            )


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


def drawn_crop(
    scene: SceneArrays,
    diameter: Scalar,
    key: PRNGKey,
    num_points: int,
    normal_points: int,
    smooth: SmoothConfig | None,
) -> Crop:
    """Return some of the points within a diameter of a scene's first point, with their normals, relative to it."""
    crops = CropConfig(
        num_points=num_points,
        max_noise=0.0,
        normal_points=normal_points,
        min_points=min(16, num_points),
        smooth=smooth,
    )
    nowhere = jnp.zeros((1, 3)), jnp.eye(4)[None]
    return crop_around(key, as_visible(scene), jnp.int32(0), jnp.bool_(True), *nowhere, diameter, crops)


def crop_for_draws(part: PartArrays, scene: SceneArrays, key: PRNGKey, num_points: int, config: CropPoseConfig) -> Crop:
    """Return the crop around a scene's first point that holds all draws, as `crop_pose` takes it with the same key."""
    count = config.num_draws * (num_points - 1) + 1
    return drawn_crop(scene, part.diameter, _crop_key(key), count, config.normal_points, config.smooth)


def said_of_draws(network: KeyMatchNet, part: PartArrays, crop: Crop, config: CropPoseConfig) -> Said:
    """Return what the network says of each draw of a crop's points; its fields are (d, ...)."""
    count = config.num_draws
    num_points = (crop.points.shape[0] - 1) // count + 1

    def one(draw: Int[Array, ""]) -> Said:
        # Each has the seed, and every so many-th of the others: also where there are fewer than asked for.
        rows = jnp.concatenate([jnp.zeros(1, jnp.int32), 1 + draw + count * jnp.arange(num_points - 1)])
        points, normals, mask = crop.points[rows], crop.normals[rows], crop.mask[rows]
        features = network.encode_scene(jnp.concatenate([points, normals], axis=1), part.diameter, mask)
        return Said(points, normals, mask, *network.match(features, part.features, mask))

    return jax.lax.map(one, jnp.arange(count, dtype=jnp.int32))


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


def poses_of_draws(
    said: Said, valid: Bool[Array, ""], part: PartArrays, key: PRNGKey, config: CropPoseConfig
) -> PoseResult:
    """Return the poses that the matches of each draw agree on, (d * h, ...), relative to the crop's seed."""

    def one(item: tuple[Said, Key[Array, ""]]) -> PoseResult:
        draw, key = item
        matches = matches_of(draw, part, config.matches)
        return ransac_modes(key, matches._replace(mask=matches.mask & valid), config.num_modes, config.ransac)

    keys = jax.random.split(_pose_key(key), config.num_draws)
    found: PoseResult = jax.tree.map(_flat, jax.lax.map(one, (said, keys)))
    return found


def surface_scores(
    poses: PoseResult, said: Said, seed: Float[Array, "3"], part: PartArrays, config: CropPoseConfig
) -> Float[Array, " p"]:
    """Return how well the points of all draws confirm each pose; minus infinity where there is none."""
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


@partial(jax.jit, static_argnames=("graphdef", "config", "num_points"))
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
    said = said_of_draws(nnx.merge(graphdef, parameters), part, crop, config)
    poses = poses_of_draws(said, crop.valid, part, key, config)
    best = jnp.argmax(surface_scores(poses, said, crop.seed, part, config))
    found: PoseResult = jax.tree.map(lambda leaf: leaf[best], poses)
    if config.icp is not None:
        draw: Said = jax.tree.map(lambda leaf: leaf[best // config.num_modes], said)
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
