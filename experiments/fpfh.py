"""The rival on whole bins: Open3D's FPFH features, RANSAC and ICP in the crops around seeds, in place of the network.

Seeds are spread, and poses verified, chosen and ordered, as ours are. It works on the scan's own points within a
diameter of the seed, not on the few that the network takes; its settings are those of
`experiments.evaluation.rivals.Fpfh`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from experiments.evaluation.rivals import Fpfh, described, quiet_open3d
from kmn_jax.detection import (
    Candidates,
    CropPoses,
    DepthAgreementConfig,
    DevicePart,
    Prediction,
    Scene,
    candidates_of,
    gather_evidence,
)
from kmn_jax.objects import Part
from kmn_jax.pose import PoseResult, PoseStatus

_FPFH = Fpfh()
_POINTS = 512  # of a crop by which a pose is judged


def fpfh_poses(part: Part, on_device: DevicePart, scene: Scene, rows: Int[np.ndarray, " c"]) -> Candidates:
    """Return a pose around each seed, with its evidence; the network's share is that of one that knows nothing."""
    open3d = quiet_open3d()
    open3d.utility.random.seed(int(rows[0]) if len(rows) else 0)
    model = described(part.points, part.normals, _FPFH.features, part.diameter)
    crops = [_crop_poses(open3d, part, scene, model, row) for row in rows.tolist()]
    found: CropPoses = jax.tree.map(lambda *leaves: np.stack(leaves), *crops)
    judge = partial(gather_evidence, config=DepthAgreementConfig())
    evidence = [np.asarray(judge(crop, on_device.arrays, on_device.surfels, scene.image)) for crop in crops]
    return candidates_of(found, np.stack(evidence), rows)


def _crop_poses(open3d: Any, part: Part, scene: Scene, model: Any, row: int) -> CropPoses:
    registration = open3d.pipelines.registration
    seed = scene.points[row]
    near = scene.points[((scene.points - seed) ** 2).sum(axis=1) <= part.diameter**2]
    target = described(near, None, _FPFH.features, part.diameter)
    pose, inliers, share = np.eye(4, dtype=np.float32), 0, 0.0
    there = False
    coarse = None if model is None or target is None else _FPFH.registered(model, target, part.diameter)
    if model is not None and target is not None and coarse is not None:
        gate = _FPFH.gate_voxels * _FPFH.features.voxel * part.diameter
        fine = registration.registration_icp(
            model.cloud,
            target.cloud,
            gate,
            coarse.transformation,
            registration.TransformationEstimationPointToPlane(),
        )
        pose, there = np.asarray(fine.transformation, dtype=np.float32), True
        inliers, share = len(coarse.correspondence_set), coarse.fitness
    few = near[np.linspace(0, len(near) - 1, _POINTS).astype(int)]
    mask = np.arange(_POINTS) < len(near)
    # It says nothing of single points: all of a crop count alike.
    size = (_POINTS, len(part.features))
    said = (few - seed, np.zeros((_POINTS, 3)), mask, np.tile([0, 1], (_POINTS, 1)), np.zeros(size))
    prediction = Prediction(*(jnp.asarray(array, None if array.dtype == bool else jnp.float32) for array in said))
    poses = PoseResult(
        T_scene_object=jnp.asarray(pose[None]),
        score=jnp.array([share], jnp.float32),
        num_inliers=jnp.array([inliers], jnp.int32),
        rms_error=jnp.zeros(1),
        inlier_mask=jnp.zeros((1, 1), dtype=bool),
        converged=jnp.array([there]),
        status=jnp.array([PoseStatus.OK if there else PoseStatus.NO_CONSENSUS], jnp.int32),
    )
    scores = jnp.array([0.0 if there else -jnp.inf])
    return CropPoses(poses, scores, prediction, jnp.asarray(seed), jnp.array(True))
