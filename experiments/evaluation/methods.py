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
from kmn_jax.detection import (
    CropPrediction,
    CropSearchConfig,
    Prediction,
    draw_of_crop,
    matches_of,
    network_prediction,
    placed,
    poses_at,
    predict,
    seed_crop,
)
from kmn_jax.errors import InputError
from kmn_jax.geometry import Crop, PaddedCloud
from kmn_jax.models import Model
from kmn_jax.objects import ObjectModel, Part, PartArrays, arrays_of, make_part, model_digest
from kmn_jax.pose import MatchConfig, Matches, RansacConfig

# The published scheme after the same smoothing: one draw of points, votes of those that the network takes for the
# object, one search, and its best pose is taken. The gate of normals, published as 30 degrees, is wider, as a keypoint
# near an edge is also that of points on the next face.
_GATE = CropSearchConfig().ransac.normal_gate_degrees
ONE_RANSAC = CropSearchConfig(
    num_draws=1,
    num_modes=1,
    num_poses=1,
    matches=MatchConfig(capacity=1024),
    ransac=RansacConfig(normal_gate_degrees=_GATE),
    icp=None,
)


@dataclass(frozen=True)
class Ours:
    """Our network and pose search, as users run it at given places; or another one over the first draw's matches."""

    name: str
    model: Model
    config: CropSearchConfig = field(default_factory=CropSearchConfig)
    num_keypoints: int | None = None
    search: Callable[[Matches, float, int], Float[np.ndarray, "4 4"] | None] | None = None  # see `rivals`
    crops_again: bool = False  # around the point that is nearest to the middle of the first pose, which it replaces

    @property
    def settings(self) -> Mapping[str, Any]:
        """The network's sizes, its weights' digest, and the sizes of the search."""
        own = {
            "weights": model_digest(self.model),
            "search": asdict(self.config.of_network(self.model.config)),
            "num_keypoints": self.num_keypoints,
        }
        if self.search is not None:
            own["other search"] = getattr(self.search, "settings", {})
        if self.crops_again:
            own["crops again"] = True
        return {"network": self.model.config.told(), **own}

    def prepare(self, model: ObjectModel) -> Solver:
        """Encode an object; solving covers drawing, normals, network, matches and search."""
        arrays, config = arrays_of(self.model, self.part(model)), self.config.of_network(self.model.config)

        middle = np.asarray(arrays.points, dtype=np.float64).mean(axis=0)

        def around(cloud: PaddedCloud, row: int, random_seed: int) -> Float[np.ndarray, "4 4"] | None:
            found = jax.device_get(poses_at(self.model, arrays, cloud, row, random_seed, config))
            best = found.poses.T_scene_object[0]
            return np.asarray(best, dtype=np.float64) if found.poses.converged[0] else None

        def solve(case: Case) -> Float[np.ndarray, "4 4"] | None:
            if self.search is not None:
                prediction, crop = self._first_draw(arrays, case)
                matches: Matches = jax.device_get(_matches(prediction, arrays, config.matches))
                pose = self.search(matches, float(model.diameter), case.random_seed)
                return None if pose is None else _moved(pose, np.asarray(crop.seed))
            cloud = padded(case.points)
            first = around(cloud, 0, case.random_seed)
            if first is None or not self.crops_again:
                return first
            away = np.linalg.norm(np.asarray(cloud.points) - placed(first, middle), axis=1)
            again = around(cloud, int(np.where(np.asarray(cloud.mask), away, np.inf).argmin()), case.random_seed)
            return first if again is None else again

        return solve

    def part(self, model: ObjectModel) -> Part:
        """Return an encoded object."""
        config = self.model.config
        count = self.num_keypoints or config.num_keypoints
        return make_part(model, self.model.under(replace(config, num_keypoints=count)))

    def predict(self, part: Part, case: Case) -> CropPrediction:
        """Return what the network says of the first draw of a crop."""
        prediction, crop = self._first_draw(arrays_of(self.model, part), case)
        return network_prediction(prediction, crop.seed)

    def _first_draw(self, arrays: PartArrays, case: Case) -> tuple[Prediction, Crop]:
        """Return what the network says of the first draw of a crop, and the crop."""
        config = self.config.of_network(self.model.config)
        crop = seed_crop(arrays, padded(case.points), 0, case.random_seed, config)
        return _first_prediction(*self.model, arrays, crop, config), crop


@dataclass(frozen=True)
class OwnNetworks:
    """For each object a network that was trained for it alone."""

    name: str
    models: Mapping[str, Model]  # by the objects' names
    config: CropSearchConfig = field(default_factory=CropSearchConfig)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The networks, and what Ours says of itself."""
        digests = {name: model_digest(model) for name, model in self.models.items()}
        return {"networks": digests, "search": asdict(self.config)}

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


@partial(jax.jit, static_argnames=("graphdef", "config"))
def _first_prediction(
    graphdef: nnx.GraphDef, parameters: nnx.State, part: PartArrays, crop: Crop, config: CropSearchConfig
) -> Prediction:
    return predict(nnx.merge(graphdef, parameters), part, draw_of_crop(crop, 0, part.diameter, config))


_matches = jax.jit(matches_of, static_argnames="config")


def _moved(T_crop_object: np.ndarray, seed: np.ndarray) -> Float[np.ndarray, "4 4"]:
    pose = np.array(T_crop_object, dtype=np.float64)
    pose[:3, 3] += seed
    return pose
