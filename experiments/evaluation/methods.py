"""Our pose methods on crops."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import jax
import numpy as np
from flax import nnx
from jaxtyping import Float

from experiments.evaluation.cases import Case, Solver, padded
from kmn_jax.data import Crop
from kmn_jax.detection import (
    CropPoseConfig,
    CropPrediction,
    Said,
    SceneArrays,
    crop_for_draws,
    crop_pose,
    draw_of_crop,
    matches_of,
    said_of_draw,
)
from kmn_jax.errors import InputError
from kmn_jax.models import Model, model_structure
from kmn_jax.objects import ObjectModel, Part, PartArrays, arrays_of, make_part, model_digest
from kmn_jax.pose import Matches, RansacConfig
from kmn_jax.typing import PRNGKey

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
        """The network's sizes, its weights' digest, and the sizes of the search."""
        own = {"weights": model_digest(self.model), **asdict(self.config)}
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
                matches: Matches = jax.device_get(_matches(said, arrays, config.matches))
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
        points, taken, keypoint, mask = (
            np.asarray(field)
            for field in (said.points + seed[None], said.on_object, said.logits.argmax(axis=1), said.mask)
        )
        return CropPrediction(points[mask], taken[mask], keypoint[mask].astype(np.int32))

    def _said(self, arrays: PartArrays, scene: SceneArrays, key: PRNGKey) -> tuple[Said, jax.Array]:
        """Return what the network says of the first draw of `crop_pose` with the same key, and the crop's seed."""
        count, config = self._num_points, self.config.pose
        crop = crop_for_draws(arrays, scene, key, count, config)
        return _first_said(self.model.graphdef, self.model.parameters, arrays, crop, count, config), crop.seed

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

    def check(self, names: Sequence[str]) -> None:
        """Raise InputError if there is no network of one of these objects."""
        without = [name for name in names if name not in self.models]
        if without:
            raise InputError(
                f"there is no network of {', '.join(without)}: there are those of {', '.join(self.models)}"
            )

    def prepare(self, model: ObjectModel) -> Solver:
        """Prepare an object with its own network. Raises InputError if there is none."""
        self.check([model.name])
        return Ours(self.name, self.models[model.name], self.config).prepare(model)


@partial(jax.jit, static_argnames=("graphdef", "config", "num_points"))
def _first_said(
    graphdef: nnx.GraphDef,
    parameters: nnx.State,
    part: PartArrays,
    crop: Crop,
    num_points: int,
    config: CropPoseConfig,
) -> Said:
    draw = draw_of_crop(crop, 0, part.diameter, num_points, config)
    return said_of_draw(nnx.merge(graphdef, parameters), part, draw)


_matches = jax.jit(matches_of, static_argnames="config")


def _moved(T_crop_object: np.ndarray, seed: np.ndarray) -> Float[np.ndarray, "4 4"]:
    pose = np.array(T_crop_object, dtype=np.float64)
    pose[:3, 3] += seed
    return pose
