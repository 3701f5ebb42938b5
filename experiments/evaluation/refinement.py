"""The refinement that the poses of all methods get: our ICP on the points of the crop."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.evaluation.cases import Case, padded
from kmn_jax.data import CropConfig
from kmn_jax.detection import first_crop
from kmn_jax.geometry import SmoothConfig
from kmn_jax.objects import ObjectModel
from kmn_jax.pose import IcpConfig, icp

CONFIG = IcpConfig(iterations=20)
_OBJECT_POINTS = 1024
_CROP = CropConfig(num_points=512, max_noise=0.0, normal_points=4096, min_points=16, smooth=SmoothConfig())
SETTINGS = {"icp": CONFIG, "object points": _OBJECT_POINTS, "scene": _CROP}


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
        crop = _crop(padded(case.points), self._diameter, jax.random.key(case.random_seed))
        fine = _fine(
            self._points,
            crop.points,
            pose.astype(np.float32),
            self._diameter,
            scene_normals=crop.normals,
            scene_mask=crop.mask,
        )
        pose = np.asarray(fine.T_scene_object, dtype=np.float64)
        pose[:3, 3] += origin
        return pose


_crop = jax.jit(partial(first_crop, config=_CROP))  # of points around the first one, for every capacity
_fine = jax.jit(partial(icp, config=CONFIG))
