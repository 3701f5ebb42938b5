"""The refinement that the poses of all methods get: our ICP on the points of the crop."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from experiments.evaluation.cases import Case, padded
from kmn_jax.geometry import PaddedCloud, SmoothConfig, draw_rows, with_normals
from kmn_jax.objects import ObjectModel
from kmn_jax.pose import IcpConfig, icp
from kmn_jax.typing import PRNGKey, Scalar

CONFIG = IcpConfig(iterations=20)
_OBJECT_POINTS = 1024
_POINTS, _DRAWN = 512, 4096  # of a crop, and of all that its normals are estimated from
_SMOOTH = SmoothConfig()
SETTINGS = {"icp": CONFIG, "object points": _OBJECT_POINTS, "points": (_POINTS, _DRAWN), "smooth": _SMOOTH}


class Refinement:
    """Refine poses of one object."""

    def __init__(self, model: ObjectModel) -> None:
        self._points = jnp.asarray(model.points[:_OBJECT_POINTS], dtype=jnp.float32)
        self._diameter = jnp.float32(model.diameter)

    def __call__(self, case: Case, T_camera_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Return the pose that ICP ends at."""
        origin = case.points[0].astype(np.float64)
        pose = T_camera_object.copy()
        pose[:3, 3] -= origin
        points, normals, mask = _points(padded(case.points), self._diameter, jax.random.key(case.random_seed), _POINTS)
        fine = _fine(
            self._points,
            points,
            pose.astype(np.float32),
            self._diameter,
            scene_normals=normals,
            scene_mask=mask,
        )
        pose = np.asarray(fine.T_scene_object, dtype=np.float64)
        pose[:3, 3] += origin
        return pose


def crop_points(
    cloud: PaddedCloud, diameter: Scalar, key: PRNGKey, count: int
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Bool[Array, " n"]]:
    """Return so many points around a cloud's first one, relative to it, smoothed, with normals; and which are real."""
    offsets = cloud.points - cloud.points[:1]
    inside = cloud.mask & ((offsets**2).sum(axis=1) <= diameter**2)
    key = jax.random.split(key, 3)[0]
    rows, drawn, kept = draw_rows(key, inside.astype(jnp.float32), jnp.int32(0), jnp.bool_(True), _DRAWN, count)
    around = jnp.where(drawn[:, None], offsets[rows], 0)
    mask = drawn[kept]
    camera = -cloud.points[0]
    points, normals = with_normals(around[kept], mask, around, drawn, camera, diameter, 0.0, _SMOOTH)
    return points, normals, mask


_points = jax.jit(crop_points, static_argnames="count")
_fine = jax.jit(partial(icp, config=CONFIG))
