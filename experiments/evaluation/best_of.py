"""Rivals that choose among several poses by the measured surface, as our search does.

The comparison is that of our search, `kmn_jax.pose.surface_agreement`, on as many points as one of our draws has,
smoothed in the same way. What our network adds has no counterpart: which points are on the object (here all of the
crop's count), and the share of matches that agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.evaluation.cases import Case, Solver, padded
from experiments.evaluation.refinement import crop_points
from kmn_jax.detection import CropSearchConfig
from kmn_jax.geometry import PaddedCloud
from kmn_jax.objects import ObjectModel
from kmn_jax.pose import surface_agreement
from kmn_jax.typing import PRNGKey, Scalar

_POINTS = 1024  # of a crop
_SEARCH = CropSearchConfig()  # of which the comparison is

SeveralPoses: TypeAlias = Callable[[Case, int], list[Float[np.ndarray, "4 4"]]]


class Several(Protocol):
    """A method that has more than one pose of a crop, the best by its own score first."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """All that decides its poses."""

    def prepare_several(self, model: ObjectModel) -> SeveralPoses:
        """Return what gives up to so many poses of a case, the one that the method alone would give first."""


@dataclass(frozen=True)
class BestOf:
    """Of several poses of a rival the one that the measured surface confirms best."""

    name: str
    base: Several
    num_poses: int

    @property
    def settings(self) -> Mapping[str, Any]:
        """Those of the rival, and of the choice."""
        return {
            "of": dict(self.base.settings),
            "num_poses": self.num_poses,
            "points": _POINTS,
            "object points": _SEARCH.surface_points,
            "surface": str(_SEARCH.surface),
        }

    def prepare(self, model: ObjectModel) -> Solver:
        """Return a solver; solving covers all poses and the choice."""
        several = self.base.prepare_several(model)
        count = _SEARCH.surface_points
        surface, normals = (jnp.asarray(values[:count], dtype=jnp.float32) for values in (model.points, model.normals))
        diameter = jnp.float32(model.diameter)

        def solve(case: Case) -> Float[np.ndarray, "4 4"] | None:
            poses = several(case, self.num_poses)
            if not poses:
                return None
            relative = np.tile(np.eye(4), (self.num_poses, 1, 1))
            relative[: len(poses)] = poses
            relative[:, :3, 3] -= case.points[0]
            key = jax.random.key(case.random_seed)
            scores = _scores(padded(case.points), surface, normals, relative.astype(np.float32), diameter, key)
            return poses[int(np.asarray(scores)[: len(poses)].argmax())]

        return solve


@jax.jit
def _scores(
    cloud: PaddedCloud,
    surface: Float[Array, "m 3"],
    normals: Float[Array, "m 3"],
    poses: Float[Array, "p 4 4"],
    diameter: Scalar,
    key: PRNGKey,
) -> Float[Array, " p"]:
    """Return how well a crop's points confirm poses, which are relative to its first point."""
    points, point_normals, mask = crop_points(cloud, diameter, key, _POINTS)

    def score(pose: Float[Array, "4 4"]) -> Scalar:
        given = (pose, surface, normals, points, point_normals, mask, mask, -cloud.points[0], diameter, _SEARCH.surface)
        return surface_agreement(*given).score

    return jax.lax.map(score, poses)
