"""The rival: Open3D's FPFH features, RANSAC and ICP in the crops around the same seeds, in place of the network.

It works on the scan's own points within a diameter of the seed, not on the few that the network takes, thinned to
voxels of `VOXEL` diameters; radii and thresholds are the multiples of the voxel that Open3D's own tutorial names.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from kmn_jax.estimator.candidates import Solver
from kmn_jax.estimator.part import Part
from kmn_jax.estimator.scene import Scene
from kmn_jax.estimator.search import CropFeatures, Hypotheses, Predictions
from kmn_jax.typing import PRNGKey

VOXEL = 0.04  # of the diameter
_ITERATIONS = 100_000
_CONFIDENCE = 0.999


def fpfh_poses(part: Part, scene: Scene, crops: CropFeatures, key: PRNGKey) -> tuple[Hypotheses, Predictions]:
    """Return a pose for each crop; see `kmn_jax.estimator.candidates.Solver`."""
    import open3d

    registration = open3d.pipelines.registration
    open3d.utility.random.seed(int(jax.random.randint(key, (), 0, 2**31 - 1)))
    voxel = VOXEL * part.diameter
    model = _cloud(part.points, part.normals, voxel)
    model_features = _features(model, voxel)
    seeds, valid = np.asarray(crops.seed), np.asarray(crops.valid)
    count, size = np.asarray(crops.mask).shape
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    found, inliers = np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int32)
    share = np.zeros(count, dtype=np.float32)
    for row in np.flatnonzero(valid):
        near = ((scene.points - seeds[row]) ** 2).sum(axis=1) <= part.diameter**2
        target = _cloud(scene.points[near], None, voxel)
        if len(target.points) < 10:
            continue
        coarse = registration.registration_ransac_based_on_feature_matching(
            model,
            target,
            model_features,
            _features(target, voxel),
            True,
            1.5 * voxel,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
            ],
            registration.RANSACConvergenceCriteria(_ITERATIONS, _CONFIDENCE),
        )
        if not len(coarse.correspondence_set):
            continue
        fine = registration.registration_icp(
            model, target, 1.5 * voxel, coarse.transformation, registration.TransformationEstimationPointToPlane()
        )
        poses[row], found[row] = fine.transformation, True
        inliers[row], share[row] = len(coarse.correspondence_set), coarse.fitness
    columns = (poses, found, inliers, share)
    # It says nothing of single points: all of a crop count alike.
    said = Predictions(crops.mask, jnp.zeros((count, size, len(part.features))))
    return Hypotheses(*(jnp.asarray(column)[:, None] for column in columns)), said


def _cloud(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"] | None, voxel: float) -> Any:
    """Return a thinned cloud with normals; those of a scan are estimated and look at the sensor."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    if normals is None:
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=2 * voxel, max_nn=30))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
    else:
        cloud.normals = open3d.utility.Vector3dVector(normals.astype(np.float64))
    return cloud.voxel_down_sample(voxel)


def _features(cloud: Any, voxel: float) -> Any:
    import open3d

    search = open3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
    return open3d.pipelines.registration.compute_fpfh_feature(cloud, search)


SOLVERS: dict[str, Solver | None] = {"kmn_jax": None, "FPFH": fpfh_poses}
