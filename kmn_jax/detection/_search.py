"""Pose hypotheses of a whole bin: one crop around each seed point, all in one call, each with its best pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key

from kmn_jax.data import CropConfig, crop_around
from kmn_jax.detection._scan_crop import SceneArrays, as_visible, even_rows
from kmn_jax.geometry import farthest_point_indices
from kmn_jax.objects import PartArrays
from kmn_jax.pose import IcpConfig, MatchConfig, PoseResult, RansacConfig, find_matches, icp, ransac_modes
from kmn_jax.typing import PRNGKey, Scalar

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class SearchConfig:
    """How poses are searched around a seed; lengths are shares of the object's diameter."""

    matches: MatchConfig = field(default_factory=lambda: MatchConfig(capacity=1024))
    ransac: RansacConfig = field(default_factory=lambda: RansacConfig(num_hypotheses=500, num_candidates=8192))
    num_modes: int = 3  # poses of a crop that are refined
    icp: IcpConfig = field(default_factory=lambda: IcpConfig(iterations=6))
    icp_points: int = 128  # of a crop, on the object
    normal_radius: float = 0.06
    normal_points: int = 4096  # drawn around a seed for normals; the network's number of them is the crop


class CropFeatures(NamedTuple):
    """Crops around s seeds, as the network sees them; points are relative to the seed, in the scene's axes and unit."""

    points: Float[Array, "s n 3"]
    normals: Float[Array, "s n 3"]
    mask: Bool[Array, "s n"]
    seed: Float[Array, "s 3"]
    valid: Bool[Array, " s"]  # whether enough points are around the seed
    features: Float[Array, "s n f"]


class Hypotheses(NamedTuple):
    """h poses for each of s seeds, in the scene's frame and unit."""

    T_scene_object: Float[Array, "s h 4 4"]  # the identity where there is none
    found: Bool[Array, "s h"]
    num_inliers: Int[Array, "s h"]  # matches that agree on it
    inlier_share: Float[Array, "s h"]  # of the usable matches


class Predictions(NamedTuple):
    """What the network says of the n points of s crops."""

    on_object: Bool[Array, "s n"]  # taken for the seed's instance
    scores: Float[Array, "s n k"]  # of the keypoints, 1 in sum


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


def seed_keys(key: PRNGKey, count: int) -> tuple[Key[Array, " s"], Key[Array, " s"]]:
    """Return keys of so many crops, and of the pose searches in them."""
    crop_key, pose_key = jax.random.split(key)
    return jax.random.split(crop_key, count), jax.random.split(pose_key, count)


@partial(jax.jit, static_argnames=("graphdef", "config", "num_points"))
def crop_features(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    scene: SceneArrays,
    seeds: Int[Array, " s"],
    real: Bool[Array, " s"],
    length: Scalar,
    keys: Key[Array, " s"],
    config: SearchConfig,
    num_points: int,
) -> CropFeatures:
    """Return the features of crops of radius `length`, an object's diameter, around seed rows of the scene.

    Where `real` is false the crop is empty and not valid.
    """
    network = nnx.merge(graphdef, parameters)
    visible = as_visible(scene)
    crops = CropConfig(
        num_points=num_points,
        max_noise=0.0,
        normal_radius=config.normal_radius,
        normal_points=config.normal_points,
        min_points=min(16, num_points),
    )

    def one(seed: Int[Array, ""], key: Key[Array, ""]) -> CropFeatures:
        crop = crop_around(key, visible, seed, scene.mask[seed], jnp.zeros((1, 3)), jnp.eye(4)[None], length, crops)
        cloud = jnp.concatenate([crop.points, crop.normals], axis=1)
        features = network.encode_scene(cloud, length, crop.mask)
        return CropFeatures(crop.points, crop.normals, crop.mask, crop.seed, crop.valid, features)

    return each(one, real, seeds, keys)


@partial(jax.jit, static_argnames=("graphdef", "config"))
def search(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    crops: CropFeatures,
    keys: Key[Array, " s"],
    config: SearchConfig,
) -> tuple[Hypotheses, Predictions]:
    """Return the best poses of a part in each valid crop, and what the network says of its points."""
    network = nnx.merge(graphdef, parameters)
    num_keypoints = part.features.shape[0]
    keypoints, keypoint_normals = part.points[:num_keypoints], part.normals[:num_keypoints]

    def one(crop: CropFeatures, key: Key[Array, ""]) -> tuple[Hypotheses, Predictions]:
        segmentation, logits = network.match(crop.features, part.features, crop.mask)
        matches = find_matches(
            segmentation,
            logits,
            crop.points,
            crop.normals,
            keypoints,
            keypoint_normals,
            part.diameter,
            crop.mask,
            config.matches,
        )
        on_object = crop.mask & (segmentation[:, 1] > segmentation[:, 0])
        coarse = ransac_modes(key, matches, config.num_modes, config.ransac)
        rows, real = spread_rows(on_object, config.icp_points)

        def refined(coarse: PoseResult) -> Hypotheses:
            fine = icp(
                part.points,
                crop.points[rows],
                coarse.T_scene_object,
                part.diameter,
                scene_normals=crop.normals[rows],
                scene_mask=real,
                config=config.icp,
            )
            pose = fine.T_scene_object.at[:3, 3].add(crop.seed)
            return Hypotheses(pose, coarse.converged, coarse.num_inliers, coarse.score)

        found = jax.lax.platform_dependent(
            coarse, cpu=lambda modes: jax.lax.map(refined, modes), default=jax.vmap(refined)
        )
        return found, Predictions(on_object, jax.nn.softmax(logits, axis=1))

    found, predictions = each(one, crops.valid, crops, keys)
    poses = jnp.where(found.found[:, :, None, None], found.T_scene_object, jnp.eye(4)[None, None])
    return found._replace(T_scene_object=poses), predictions


def spread_rows(mask: Bool[Array, " n"], count: int) -> tuple[Int[Array, " c"], Bool[Array, " c"]]:
    """Return rows where a mask is true, evenly chosen among them if they are more than `count`, and which are real."""
    count = min(count, mask.shape[0])
    total = mask.sum(dtype=jnp.int32)
    order = jnp.nonzero(mask, size=mask.shape[0], fill_value=0)[0]
    place = jnp.arange(count, dtype=jnp.int32)
    return order[jnp.where(total > count, even_rows(place, total, count), place)], place < total


def each(function: Callable[..., _Result], real: Bool[Array, " s"], *items: Any) -> _Result:
    """Map over leading axes, to zeros where `real` is false.

    On CPUs one item comes after the other, as side by side what is computed leaves the cache, and what is not real is
    skipped.
    """
    first = jax.tree.map(lambda leaf: leaf[0], items)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *first))

    def one(real: Bool[Array, ""], *item: Any) -> _Result:
        return jax.lax.cond(real, function, lambda *item: zeros, *item)

    return jax.lax.platform_dependent(
        real, *items, cpu=lambda *items: jax.lax.map(lambda item: one(*item), items), default=jax.vmap(one)
    )
