"""Pose hypotheses of a whole bin: one crop around each seed point, all in one call, each with its best pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key

from kmn_jax.data.crops import CropConfig, crop_around
from kmn_jax.data.splat import BIN, VisiblePoints
from kmn_jax.geometry import farthest_point_indices
from kmn_jax.pose import IcpConfig, MatchConfig, RansacConfig, find_matches, icp, ransac
from kmn_jax.typing import Points, Pose, PRNGKey, Scalar


@dataclass(frozen=True)
class SearchConfig:
    """How poses are searched around a seed; lengths are shares of the object's diameter."""

    matches: MatchConfig = field(default_factory=MatchConfig)
    ransac: RansacConfig = field(default_factory=RansacConfig)
    icp: IcpConfig = field(default_factory=IcpConfig)
    normal_radius: float = 0.06
    normal_points: int = 4096  # drawn around a seed for normals; the network's number of them is the crop


class PartArrays(NamedTuple):
    """What a search needs of an object, in the scene's unit."""

    points: Float[Array, "m 3"]
    features: Float[Array, "k o"]
    keypoints: Float[Array, "k 3"]
    keypoint_normals: Float[Array, "k 3"]
    diameter: Scalar


class SceneArrays(NamedTuple):
    """A scan in its sensor's frame, padded to a capacity: the sensor is at the origin."""

    points: Float[Array, "r 3"]
    mask: Bool[Array, " r"]


class Hypotheses(NamedTuple):
    """A pose for each of s seeds, and what speaks for it; lengths in the scene's unit."""

    T_scene_object: Float[Array, "s 4 4"]
    found: Bool[Array, " s"]  # whether there is a pose at all
    num_inliers: Int[Array, " s"]  # matches that agree on it
    inlier_share: Float[Array, " s"]  # of the usable matches
    num_object_points: Int[Array, " s"]  # of the crop that the network takes for the seed's instance
    object_share: Float[Array, " s"]  # of the crop's points
    fit: Float[Array, " s"]  # share of those points that the refined pose meets
    rms_error: Float[Array, " s"]


def spread_seeds(
    scene: SceneArrays, candidates: Bool[Array, " r"], count: int
) -> tuple[Int[Array, " count"], Bool[Array, " count"]]:
    """Return rows of candidates spread over the scene, each the farthest from those before it, and which are real.

    With fewer candidates than `count` the others repeat one, and are not real.
    """
    usable = scene.mask & candidates
    anchor = jnp.argmax(usable).astype(jnp.int32)
    # What is no candidate sits on one: it is the farthest only when no other is left.
    rows = farthest_point_indices(jnp.where(usable[:, None], scene.points, scene.points[anchor][None]), count, None)
    rows = jnp.where(usable[rows], rows, anchor)
    same = jnp.tril(rows[:, None] == rows[None, :], -1).any(axis=1)
    return rows, ~same & usable[anchor]


@partial(jax.jit, static_argnames=("graphdef", "config", "num_points"))
def search(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    scene: SceneArrays,
    seeds: Int[Array, " s"],
    key: PRNGKey,
    config: SearchConfig,
    num_points: int,
) -> Hypotheses:
    """Return the best pose around each seed row of the scene."""
    crops = CropConfig(
        num_points=num_points,
        max_noise=0.0,
        normal_radius=config.normal_radius,
        normal_points=config.normal_points,
        min_points=min(16, num_points),
    )

    def one(seed: Int[Array, ""], key: Key[Array, ""]) -> Hypotheses:
        return _hypothesis(graphdef, parameters, part, scene, seed, key, config, crops)

    keys = jax.random.split(key, seeds.shape[0])
    # One after the other on CPUs, where side by side what is computed leaves the cache.
    return jax.lax.platform_dependent(
        seeds, keys, cpu=lambda s, k: jax.lax.map(lambda pair: one(*pair), (s, k)), default=jax.vmap(one)
    )


def _hypothesis(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    scene: SceneArrays,
    seed: Int[Array, ""],
    key: Key[Array, ""],
    config: SearchConfig,
    crops: CropConfig,
) -> Hypotheses:
    network = nnx.merge(graphdef, parameters)
    crop_key, pose_key = jax.random.split(key)
    crop = crop_around(
        crop_key,
        _as_visible(scene),
        seed,
        scene.mask[seed],
        jnp.zeros((1, 3)),
        jnp.eye(4)[None],
        part.diameter,
        crops,
    )
    cloud = jnp.concatenate([crop.points, crop.normals], axis=1)
    features = network.encode_scene(cloud, part.diameter, crop.mask)
    segmentation, logits = network.match(features, part.features, crop.mask)
    matches = find_matches(
        segmentation,
        logits,
        crop.points,
        crop.normals,
        part.keypoints,
        part.keypoint_normals,
        part.diameter,
        crop.mask,
        config.matches,
    )
    coarse = ransac(pose_key, matches, config.ransac)
    on_object = crop.mask & (segmentation[:, 1] > segmentation[:, 0])
    fine = icp(
        part.points,
        crop.points,
        coarse.T_scene_object,
        part.diameter,
        scene_normals=crop.normals,
        scene_mask=on_object,
        config=config.icp,
    )
    count = on_object.sum(dtype=jnp.int32)
    return Hypotheses(
        T_scene_object=_moved(fine.T_scene_object, crop.seed),
        found=crop.valid & coarse.converged,
        num_inliers=coarse.num_inliers,
        inlier_share=coarse.score,
        num_object_points=count,
        object_share=count / jnp.maximum(crop.mask.sum(), 1),
        fit=fine.score,
        rms_error=fine.rms_error,
    )


def _as_visible(scene: SceneArrays) -> VisiblePoints:
    """Return a scan as visible points that all count alike."""
    return VisiblePoints(
        points=scene.points,
        normals=jnp.zeros_like(scene.points),
        picture_area=jnp.ones_like(scene.points[:, 0]),
        instance=jnp.full(scene.mask.shape, BIN, dtype=jnp.int32),
        mask=scene.mask,
        visible_fraction=jnp.ones(1),
    )


def _moved(pose: Pose, offset: Float[Array, " 3"]) -> Pose:
    return pose.at[:3, 3].add(offset)


def part_arrays(points: Points, normals: Points, features: Array, diameter: Scalar, num_points: int) -> PartArrays:
    """Return an object's arrays: its first points for refinement, the first K of them as keypoints."""
    count = features.shape[0]
    return PartArrays(points[:num_points], features, points[:count], normals[:count], diameter)
