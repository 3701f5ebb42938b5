"""Candidates: the poses around seeds of a scene, and what speaks for and against each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Bool, Float, Float32, Int, UInt32

from kmn_jax.detection._crop_search import CropPoses, crop_of_scene, find_poses_in_crop
from kmn_jax.detection._depth_agreement import DepthAgreementConfig, DepthImage
from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._draw import CropSearchConfig, Prediction
from kmn_jax.detection._evidence import PICTURE_EVIDENCE, gather_evidence, picture_columns
from kmn_jax.detection._mapping import call_rows
from kmn_jax.detection._result import CropPrediction
from kmn_jax.detection._scene import Scene
from kmn_jax.geometry import Crop, PaddedCloud
from kmn_jax.models import KeyMatchNetConfig, Model
from kmn_jax.objects import PartArrays
from kmn_jax.pose import PoseResult
from kmn_jax.typing import PRNGKey

_KEYS = 128  # that are made at once
_MOST_DRAWS = 2  # around each seed, where a scene is searched all over


@dataclass(frozen=True)
class SearchConfig:
    """How poses are searched around seeds, and compared with the depth image."""

    crops: CropSearchConfig = field(default_factory=CropSearchConfig)
    agreement: DepthAgreementConfig = field(default_factory=DepthAgreementConfig)

    def of_network(self, config: KeyMatchNetConfig) -> SearchConfig:
        """Return the same for a search all over a scene, with the numbers of draws and of their points, unless given.

        Several seeds lie on each copy there, so that draws may be few, and small: of as many points as the network was
        trained with. Around a single point more and larger ones find more, see `CropSearchConfig.of_network`.
        """
        crops = self.crops
        num_points, num_draws = crops.num_points or config.num_scene_points, crops.num_draws or _MOST_DRAWS
        return replace(self, crops=replace(crops, num_points=num_points, num_draws=num_draws))


class Candidates(NamedTuple):
    """Poses of a part, each with its evidence; arrays on the host, lengths in the scene's unit."""

    T_camera_object: Float32[np.ndarray, "s 4 4"]
    usable: Bool[np.ndarray, " s"]  # whether a pose was found
    evidence: Float32[np.ndarray, "s f"]  # see EVIDENCE
    num_inliers: Int[np.ndarray, " s"]
    crop: Int[np.ndarray, " s"]  # that it was found in, of c
    found: CropPoses  # of the crops, (c, ...)
    seed_rows: Int[np.ndarray, " c"]  # of the crops, in the scene's points

    @property
    def is_first(self) -> Bool[np.ndarray, " s"]:
        """Which poses are the first ones of their crops: those that the surface confirms best."""
        return np.diff(self.crop, prepend=-1) > 0


def search_at(
    model: Model, part: DevicePart, scene: Scene, rows: Int[np.ndarray, " c"], random_seed: int, config: SearchConfig
) -> Candidates:
    """Return the poses in the crops around seeds; `config` is that of a network, see `SearchConfig.of_network`.

    What is found around a point does not depend on what else is searched.
    """
    keys = seed_keys(rows, random_seed)
    given = (*model, part, scene.cloud, scene.image)
    found, evidence = call_rows(
        lambda row, key: search_one(*given, row, jax.random.wrap_key_data(key), config),
        partial(_search_many, *given, config=config),
        rows.astype(np.int32),
        keys,
    )
    return candidates_of(found, evidence, rows)


def poses_at(
    model: Model, part: PartArrays, cloud: PaddedCloud, row: int, random_seed: int, config: CropSearchConfig
) -> CropPoses:
    """Return the poses around the point in a row of a cloud, as a search of a scene of these points finds them."""
    return _poses_around(*model, part, cloud, np.int32(row), _seed_key(row, random_seed), config)


def seed_crop(part: PartArrays, cloud: PaddedCloud, row: int, random_seed: int, config: CropSearchConfig) -> Crop:
    """Return the crop that `poses_at` with the same arguments searches."""
    crop_key, _ = jax.random.split(_seed_key(row, random_seed))
    return crop_of_scene(cloud, np.int32(row), part.diameter, crop_key, config)


def _poses_around(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    cloud: PaddedCloud,
    row: Int[ArrayLike, ""],
    key: PRNGKey,
    config: CropSearchConfig,
) -> CropPoses:
    crop_key, pose_key = jax.random.split(key)
    crop = crop_of_scene(cloud, row, part.diameter, crop_key, config)
    return find_poses_in_crop(graphdef, parameters, part, crop, pose_key, config)


def no_poses(config: CropSearchConfig, num_keypoints: int) -> CropPoses:
    """Return the poses of a crop that has none, in arrays like those of one that has some."""
    poses, matches, points = config.num_poses, config.matches.capacity, config.points_of_draw

    def zeros(*shape: int, dtype: Any = np.float32) -> Any:
        return np.zeros(shape, dtype=dtype)

    found = PoseResult(
        T_scene_object=zeros(poses, 4, 4) + np.eye(4, dtype=np.float32),
        score=zeros(poses),
        num_inliers=zeros(poses, dtype=np.int32),
        rms_error=zeros(poses),
        inlier_mask=zeros(poses, matches, dtype=bool),
        converged=zeros(poses, dtype=bool),
        status=zeros(poses, dtype=np.int32),
    )
    draw = zeros(points, 3), zeros(points, 3), zeros(points, dtype=bool), zeros(points, 2), zeros(points, num_keypoints)
    none: CropPoses = jax.device_put(
        CropPoses(found, zeros(poses) - np.float32(np.inf), Prediction(*draw), zeros(3), zeros(dtype=bool))
    )
    return none


def seed_keys(rows: Int[np.ndarray, " c"], random_seed: int) -> UInt32[np.ndarray, "c 2"]:
    """Return the data of each seed's random key, see `jax.random.wrap_key_data`."""
    padded = np.zeros(len(rows) + -len(rows) % _KEYS, dtype=np.int32)  # few numbers are ever compiled
    padded[: len(rows)] = rows
    return np.asarray(_keys(jax.random.key(random_seed), padded))[: len(rows)]


def _seed_key(row: int, random_seed: int) -> PRNGKey:
    return jax.random.wrap_key_data(seed_keys(np.array([row]), random_seed)[0])


def picture_evidence(
    T_camera_object: Float32[np.ndarray, "s 4 4"], part: DevicePart, scene: Scene, config: DepthAgreementConfig
) -> Float32[np.ndarray, "s f"]:
    """Return what the depth image shows of poses that were found before, in the order of PICTURE_EVIDENCE."""
    if not len(T_camera_object):
        return np.zeros((0, len(PICTURE_EVIDENCE)), dtype=np.float32)
    given = part.surfels, scene.image, part.arrays.diameter, config
    return call_rows(lambda pose: _columns(pose, *given), lambda poses: _columns_of(poses, *given), T_camera_object)


def candidates_of(found: CropPoses, evidence: Float[np.ndarray, "c h f"], rows: Int[np.ndarray, " c"]) -> Candidates:
    """Return what was found in crops as candidates."""
    count, modes = found.poses.converged.shape
    poses: Any = jax.tree.map(lambda leaf: leaf.reshape(count * modes, *leaf.shape[2:]), found.poses)
    return Candidates(
        poses.T_scene_object,
        poses.converged,
        evidence.reshape(count * modes, -1),
        poses.num_inliers,
        np.repeat(np.arange(count), modes),
        found,
        rows,
    )


def join(parts: list[Candidates]) -> Candidates:
    """Return the candidates of several searches as one."""
    starts = np.cumsum([0, *(len(part.seed_rows) for part in parts)])
    shifted = [part._replace(crop=part.crop + start) for part, start in zip(parts, starts, strict=False)]
    joined: Any = jax.tree.map(lambda *leaves: np.concatenate(leaves), *shifted)
    return cast(Candidates, joined)


def crop_prediction(found: Candidates, row: int) -> CropPrediction:
    """Return what the network says of the crop of a candidate, in the camera's frame."""
    crop: CropPoses = jax.tree.map(lambda leaf: leaf[found.crop[row]], found.found)
    return network_prediction(crop.prediction, crop.seed)


def network_prediction(prediction: Prediction, seed: Float[Array | np.ndarray, "3"]) -> CropPrediction:
    """Return what the network says of a draw's points, as a plain record in the frame that the seed is in."""
    points, segmentation, logits = (
        np.asarray(leaf)[np.asarray(prediction.mask)]
        for leaf in (prediction.points, prediction.segmentation, prediction.logits)
    )
    on_object = segmentation[:, 1] > segmentation[:, 0]
    return CropPrediction(points + np.asarray(seed), on_object, logits.argmax(axis=1).astype(np.int32))


def search_one(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: DevicePart,
    cloud: PaddedCloud,
    image: DepthImage,
    row: Int[ArrayLike, ""],
    key: PRNGKey,
    config: SearchConfig,
) -> tuple[CropPoses, Float[Array, "h f"]]:
    """Return the poses around the point in a row, and the evidence on each; `config` is that of a network.

    Three compiled calls, of which the size of the cloud enters the first alone, and that of the image the last.
    """
    found = _poses_around(graphdef, parameters, part.arrays, cloud, row, key, config.crops)
    return found, gather_evidence(found, part.arrays, part.surfels, image, config.agreement)


@partial(jax.jit, static_argnames=("graphdef", "config"))
def _search_many(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: DevicePart,
    cloud: PaddedCloud,
    image: DepthImage,
    rows: Int[Array, " c"],
    keys: UInt32[Array, "c 2"],
    config: SearchConfig,
) -> tuple[CropPoses, Float[Array, "c h f"]]:
    def one(row: Int[Array, ""], key: PRNGKey) -> tuple[CropPoses, Float[Array, "h f"]]:
        return search_one(graphdef, parameters, part, cloud, image, row, key, config)

    return jax.vmap(one)(rows, jax.random.wrap_key_data(keys))


@jax.jit
def _keys(key: PRNGKey, rows: Int[Array, " c"]) -> UInt32[Array, "c 2"]:
    return jax.random.key_data(jax.vmap(lambda row: jax.random.fold_in(key, row))(rows))


_columns = jax.jit(picture_columns, static_argnames="config")
_columns_of = jax.jit(jax.vmap(picture_columns, in_axes=(0, None, None, None, None)), static_argnums=4)
