"""The rival: Open3D's FPFH features, RANSAC and ICP in the crops around the same seeds, in place of the network.

It works on the scan's own points within a diameter of the seed, not on the few that the network takes; its settings are
those of `experiments.evaluation.rivals.Fpfh`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from experiments.evaluation.rivals import Fpfh, described, quiet_open3d
from kmn_jax.detection import CropFeatures, Hypotheses, Predictions, Scene, Solver
from kmn_jax.objects import Part
from kmn_jax.typing import PRNGKey

_FPFH = Fpfh()


def fpfh_poses(part: Part, scene: Scene, crops: CropFeatures, key: PRNGKey) -> tuple[Hypotheses, Predictions]:
    """Return a pose for each crop; see `kmn_jax.detection._candidates.Solver`."""
    open3d = quiet_open3d()
    registration = open3d.pipelines.registration
    open3d.utility.random.seed(int(jax.random.randint(key, (), 0, 2**31 - 1)))
    gate = _FPFH.gate_voxels * _FPFH.features.voxel * part.diameter
    model = described(part.points, part.normals, _FPFH.features, part.diameter)
    seeds, valid = np.asarray(crops.seed), np.asarray(crops.valid)
    count, size = np.asarray(crops.mask).shape
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    found, inliers = np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int32)
    share = np.zeros(count, dtype=np.float32)
    for row in np.flatnonzero(valid):
        near = ((scene.points - seeds[row]) ** 2).sum(axis=1) <= part.diameter**2
        target = described(scene.points[near], None, _FPFH.features, part.diameter)
        coarse = None if model is None or target is None else _FPFH.registered(model, target, part.diameter)
        if model is None or target is None or coarse is None:
            continue
        fine = registration.registration_icp(
            model.cloud, target.cloud, gate, coarse.transformation, registration.TransformationEstimationPointToPlane()
        )
        poses[row], found[row] = fine.transformation, True
        inliers[row], share[row] = len(coarse.correspondence_set), coarse.fitness
    columns = (poses, found, inliers, share)
    # It says nothing of single points: all of a crop count alike.
    said = Predictions(crops.mask, jnp.zeros((count, size, len(part.features))))
    return Hypotheses(*(jnp.asarray(column)[:, None] for column in columns)), said


SOLVERS: dict[str, Solver | None] = {"kmn_jax": None, "FPFH": fpfh_poses}
