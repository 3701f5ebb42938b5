"""Our pose methods on crops, and what a method is.

A method is prepared once for an object, untimed, and then solves case after case. It gets what a camera gives: the
points of the crop, in the camera's frame, the seed first; and the object's points with their normals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np
from flax import nnx
from jaxtyping import Float, Float32

from experiments.evaluation.cases import Case
from kmn_jax.checks import InputError
from kmn_jax.data.cad import ObjectModel
from kmn_jax.estimator.candidates import arrays_of
from kmn_jax.estimator.crop_pose import CropPoseConfig, Said, crop_for_draws, crop_pose, matches_of, said_of_draws
from kmn_jax.estimator.part import Part, make_part, model_digest
from kmn_jax.estimator.result import CropPrediction
from kmn_jax.estimator.search import PartArrays, SceneArrays
from kmn_jax.estimator.view import padded_points
from kmn_jax.models import Model
from kmn_jax.models.keymatchnet import model_structure
from kmn_jax.pose import Matches, RansacConfig
from kmn_jax.typing import PRNGKey

Solver: TypeAlias = Callable[[Case], Float[np.ndarray, "4 4"] | None]

_LEAST_POINTS, _MOST_POINTS = 16_384, 32_768  # of a padded crop; more are thinned out at random


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


# The published scheme after the same smoothing: one draw of points, one search, and its best pose is taken.
ONE_RANSAC = CropPoseConfig(num_draws=1, num_modes=1, ransac=RansacConfig())


@dataclass(frozen=True)
class OursConfig:
    """Our pipeline up to the pose, which the shared refinement follows."""

    pose: CropPoseConfig = field(default_factory=CropPoseConfig)
    num_points: int | None = None  # of a draw that the network sees; as many as it was made for unless given
    num_keypoints: int | None = None


@dataclass(frozen=True)
class Ours:
    """Our network, and a pose search over its matches: ours, or another one over those of the first draw."""

    name: str
    model: Model
    config: OursConfig = field(default_factory=OursConfig)
    search: Callable[[Matches, float, int], Float[np.ndarray, "4 4"] | None] | None = None  # see `rivals`

    @property
    def settings(self) -> Mapping[str, Any]:
        """The network's sizes and those of the search."""
        own = asdict(self.config)
        if self.search is not None:
            own["search"] = getattr(self.search, "settings", {})
        return {"network": asdict(self.model.config), **own}

    def prepare(self, model: ObjectModel) -> Solver:
        """Encode an object; solving covers drawing, normals, network, matches and search."""
        arrays, config = arrays_of(self.model, self.part(model)), self.config.pose

        def solve(case: Case) -> Float[np.ndarray, "4 4"] | None:
            scene, key = padded(case.points), jax.random.key(case.random_seed)
            if self.search is not None:
                said, seed = self._said(arrays, scene, key)
                matches: Matches = jax.device_get(_matches(_first(said), arrays, config.matches))
                pose = self.search(matches, float(model.diameter), case.random_seed)
                return None if pose is None else _moved(pose, np.asarray(seed))
            network = self.model.graphdef, self.model.parameters
            found = jax.device_get(crop_pose(*network, arrays, scene, key, self._num_points, config))
            return np.asarray(found.T_scene_object, dtype=np.float64) if found.converged else None

        return solve

    def part(self, model: ObjectModel) -> Part:
        """Return an encoded object."""
        config = self.model.config
        count = self.config.num_keypoints or config.num_keypoints
        structure = model_structure(replace(config, num_keypoints=count))
        return make_part(model, Model(structure.graphdef, self.model.parameters))

    def predict(self, part: Part, case: Case) -> CropPrediction:
        """Return what the network says of the first draw of a crop."""
        arrays = arrays_of(self.model, part)
        said, seed = self._said(arrays, padded(case.points), jax.random.key(case.random_seed))
        first = _first(said)
        points, taken, keypoint, mask = (
            np.asarray(field)
            for field in (first.points + seed[None], first.on_object, first.logits.argmax(axis=1), first.mask)
        )
        return CropPrediction(points[mask], taken[mask], keypoint[mask].astype(np.int32))

    def _said(self, arrays: PartArrays, scene: SceneArrays, key: PRNGKey) -> tuple[Said, jax.Array]:
        network = self.model.graphdef, self.model.parameters
        return _said(*network, arrays, scene, key, self._num_points, self.config.pose)

    @property
    def _num_points(self) -> int:
        return self.config.num_points or self.model.config.num_scene_points


@dataclass(frozen=True)
class OwnNetworks:
    """For each object a network that was trained for it alone."""

    name: str
    models: Mapping[str, Model]  # by the objects' names
    config: OursConfig = field(default_factory=OursConfig)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The networks, and what Ours says of itself."""
        return {"networks": {name: model_digest(model) for name, model in self.models.items()}, **asdict(self.config)}

    def prepare(self, model: ObjectModel) -> Solver:
        """Prepare an object with its own network. Raises InputError if there is none."""
        if model.name not in self.models:
            raise InputError(f"there is no network of {model.name}: there are those of {', '.join(self.models)}")
        return Ours(self.name, self.models[model.name], self.config).prepare(model)


def padded(points: Float32[np.ndarray, "n 3"]) -> SceneArrays:
    """Return a crop in a capacity of few possible ones, its first point still the first."""
    if len(points) > _MOST_POINTS:
        rows = 1 + np.random.default_rng(0).choice(len(points) - 1, _MOST_POINTS - 1, replace=False)
        points = points[np.concatenate([[0], np.sort(rows)])]
    return SceneArrays(*padded_points(points, _LEAST_POINTS))


@partial(jax.jit, static_argnames=("graphdef", "config", "num_points"))
def _said(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    scene: SceneArrays,
    key: PRNGKey,
    num_points: int,
    config: CropPoseConfig,
) -> tuple[Said, jax.Array]:
    """Return what the network says of the draws that `crop_pose` makes with the same key, and the crop's seed."""
    crop = crop_for_draws(part, scene, key, num_points, config)
    return said_of_draws(nnx.merge(graphdef, parameters), part, crop, config), crop.seed


_matches = jax.jit(matches_of, static_argnames="config")


def _first(said: Said) -> Said:
    return Said(*(field[0] for field in said))


def _moved(T_crop_object: np.ndarray, seed: np.ndarray) -> Float[np.ndarray, "4 4"]:
    pose = np.array(T_crop_object, dtype=np.float64)
    pose[:3, 3] += seed
    return pose
