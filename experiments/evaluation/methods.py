"""Our pose methods on crops, and what a method is.

A method is prepared once for an object, untimed, and then solves case after case. It gets what a camera gives: the
points of the crop, in the camera's frame, the seed first; and the object's points with their normals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float, Float32

from experiments.evaluation.cases import Case
from kmn_jax.data.cad import ObjectModel
from kmn_jax.data.crops import Crop, CropConfig, crop_around
from kmn_jax.estimator.candidates import arrays_of
from kmn_jax.estimator.part import Part, make_part
from kmn_jax.estimator.result import CropPrediction
from kmn_jax.estimator.search import PartArrays, SceneArrays, as_visible
from kmn_jax.estimator.view import padded_points
from kmn_jax.models import Model
from kmn_jax.models.keymatchnet import model_structure
from kmn_jax.pose import MatchConfig, Matches, PoseResult, RansacConfig, find_matches, ransac
from kmn_jax.typing import PRNGKey, Scalar

Solver: TypeAlias = Callable[[Case], Float[np.ndarray, "4 4"] | None]

_LEAST_POINTS, _MOST_POINTS = 4096, 32_768  # of a padded crop; more are thinned out at random


class Method(Protocol):
    """What is compared."""

    @property
    def name(self) -> str:
        """What it is called in tables."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """All that decides its poses, for the record."""

    def prepare(self, model: ObjectModel) -> Solver:
        """Return what solves cases of an object whose lengths are in the cases' unit."""


@dataclass(frozen=True)
class OursConfig:
    """Our pipeline up to the pose search; lengths are shares of the object's diameter."""

    matches: MatchConfig = field(default_factory=MatchConfig)
    ransac: RansacConfig = field(default_factory=RansacConfig)
    normal_radius: float = 0.06
    normal_points: int = 4096
    num_points: int | None = None  # of a crop that the network sees; as many as it was made for unless given
    num_keypoints: int | None = None


@dataclass(frozen=True)
class Ours:
    """Our network, and a pose search over its matches: ours, or another one."""

    name: str
    model: Model
    config: OursConfig = field(default_factory=OursConfig)
    search: Callable[[Matches, float, int], Float[np.ndarray, "4 4"] | None] | None = None  # see `rivals`

    @property
    def settings(self) -> Mapping[str, Any]:
        """The network's sizes and those of the search."""
        own = asdict(self.config)
        if self.search is not None:
            own["ransac"] = getattr(self.search, "settings", {})
        return {"network": asdict(self.model.config), **own}

    def prepare(self, model: ObjectModel) -> Solver:
        """Encode an object; solving covers drawing, normals, network, matches and search."""
        arrays = arrays_of(self.model, self.part(model))

        def solve(case: Case) -> Float[np.ndarray, "4 4"] | None:
            said = self._say(arrays, case)
            matches, seed = _matches(said, arrays, self.config), np.asarray(said.crop.seed)
            if self.search is not None:
                pose = self.search(jax.device_get(matches), float(model.diameter), case.random_seed)
                return None if pose is None else _moved(pose, seed)
            found: PoseResult = jax.device_get(_ransac(jax.random.key(case.random_seed), matches, self.config.ransac))
            return _moved(np.asarray(found.T_scene_object), seed) if found.converged else None

        return solve

    def part(self, model: ObjectModel) -> Part:
        """Return an encoded object."""
        config = self.model.config
        count = self.config.num_keypoints or config.num_keypoints
        structure = model_structure(replace(config, num_keypoints=count))
        return make_part(model, Model(structure.graphdef, self.model.parameters))

    def predict(self, part: Part, case: Case) -> CropPrediction:
        """Return what the network says of a crop."""
        said: _Said = jax.device_get(self._say(arrays_of(self.model, part), case))
        crop, mask = said.crop, np.asarray(said.crop.mask)
        on_object = np.asarray(said.segmentation[:, 1] > said.segmentation[:, 0])
        keypoint = np.asarray(said.logits).argmax(axis=1).astype(np.int32)
        return CropPrediction(np.asarray(crop.points + crop.seed)[mask], on_object[mask], keypoint[mask])

    def _say(self, arrays: PartArrays, case: Case) -> _Said:
        return _said(
            self.model.graphdef,
            self.model.parameters,
            arrays,
            padded(case.points),
            jax.random.key(case.random_seed),
            self.config,
            self.config.num_points or self.model.config.num_scene_points,
        )


def padded(points: Float32[np.ndarray, "n 3"]) -> SceneArrays:
    """Return a crop in a capacity of few possible ones, its first point still the first."""
    if len(points) > _MOST_POINTS:
        rows = 1 + np.random.default_rng(0).choice(len(points) - 1, _MOST_POINTS - 1, replace=False)
        points = points[np.concatenate([[0], np.sort(rows)])]
    return SceneArrays(*padded_points(points, _LEAST_POINTS))


def drawn_crop(
    scene: SceneArrays, diameter: Scalar, key: PRNGKey, num_points: int, radius: float, normal_points: int
) -> Crop:
    """Return some of the points of a crop with their normals, relative to its first one."""
    crops = CropConfig(
        num_points=num_points,
        max_noise=0.0,
        normal_radius=radius,
        normal_points=normal_points,
        min_points=min(16, num_points),
    )
    visible = as_visible(scene)
    nowhere = jnp.zeros((1, 3)), jnp.eye(4)[None]
    return crop_around(key, visible, jnp.int32(0), jnp.bool_(True), *nowhere, diameter, crops)


class _Said(NamedTuple):
    """A crop relative to its first point, and what the network says of its points."""

    crop: Crop
    segmentation: Float[jax.Array, "n 2"]
    logits: Float[jax.Array, "n k"]


@partial(jax.jit, static_argnames=("graphdef", "config", "num_points"))
def _said(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    scene: SceneArrays,
    key: PRNGKey,
    config: OursConfig,
    num_points: int,
) -> _Said:
    network = nnx.merge(graphdef, parameters)
    crop = drawn_crop(scene, part.diameter, key, num_points, config.normal_radius, config.normal_points)
    cloud = jnp.concatenate([crop.points, crop.normals], axis=1)
    features = network.encode_scene(cloud, part.diameter, crop.mask)
    return _Said(crop, *network.match(features, part.features, crop.mask))


@partial(jax.jit, static_argnames="config")
def _matches(said: _Said, part: PartArrays, config: OursConfig) -> Matches:
    """Return the matches of a crop, relative to its first point."""
    count = part.features.shape[0]
    return find_matches(
        said.segmentation,
        said.logits,
        said.crop.points,
        said.crop.normals,
        part.points[:count],
        part.normals[:count],
        part.diameter,
        said.crop.mask,
        config.matches,
    )


_ransac = jax.jit(ransac, static_argnames="config")


def _moved(T_crop_object: np.ndarray, seed: np.ndarray) -> Float[np.ndarray, "4 4"]:
    pose = np.array(T_crop_object, dtype=np.float64)
    pose[:3, 3] += seed
    return pose
