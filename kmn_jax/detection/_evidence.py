"""What speaks for and against a pose: what the crop and the depth image show of it, and what the network says."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.detection._crop_search import CropPoses
from kmn_jax.detection._depth_agreement import DepthAgreement, DepthAgreementConfig, DepthImage, depth_agreement
from kmn_jax.detection._draw import Prediction
from kmn_jax.detection._mapping import map_real
from kmn_jax.detection._picture_agreement import PictureAgreement, picture_agreement
from kmn_jax.detection._surroundings import Surroundings, surroundings
from kmn_jax.detection._verification import VERIFIED
from kmn_jax.geometry import inverse, nearest, transform_points
from kmn_jax.objects import PartArrays
from kmn_jax.pose import PoseResult
from kmn_jax.programs import kept
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, Scalar

# Each is described where it is computed: `DepthAgreement`, `PictureAgreement` and `Surroundings` are of the picture.
_OF_CROP = (
    "surface",  # score of the crop's points, see `CropPoses`; of a refined pose that of the pose that it was made of
    "fit",  # share of the points on the object that are near to the pose's surface
    "rms_error",  # of these, in diameters
    "inlier_share",  # of the matches
    "log_inliers",
    "likelihood",  # mean, over the points on the object, of the probability of the keypoint nearest at the pose
    "straight",  # mean cosine of the two surfaces' normals where they meet
    "covered",  # share of the crop's points on the pose's surface that are on the object
    "certainty",  # mean probability of the likeliest keypoint
    "object_share",  # of the crop's points that are on the object
)
PICTURE_EVIDENCE = (*DepthAgreement._fields, *PictureAgreement._fields, *Surroundings._fields)
EVIDENCE = (*PICTURE_EVIDENCE, *_OF_CROP, VERIFIED)
_NEAR = 0.1  # diameters
_SURFACE = 0.05  # diameters; points so near to a surface with a normal like it lie on it
_ALIKE = 0.5  # cosine


def evidence_on(
    found: CropPoses, part: PartArrays, surfels: Surfels, image: DepthImage, config: DepthAgreementConfig
) -> Float[Array, "h f"]:
    """Return the evidence on each pose of a crop, in the order of EVIDENCE; zeros where there is none.

    What the verifier says is zero, too: only refined poses are shown to it, see `verified`.
    """
    prediction = found.prediction
    keypoint_scores = jax.nn.softmax(prediction.logits, axis=1)

    def of_pose(pose: PoseResult, score: Scalar) -> Float[Array, " f"]:
        return _evidence(pose, score, prediction, keypoint_scores, found.seed, part, surfels, image, config)

    return map_real(of_pose, found.poses.converged, found.poses, found.scores)


def _evidence(
    found: PoseResult,
    score: Scalar,
    prediction: Prediction,
    keypoint_scores: Float[Array, "n k"],
    seed: Float[Array, "3"],
    part: PartArrays,
    surfels: Surfels,
    image: DepthImage,
    config: DepthAgreementConfig,
) -> Float[Array, " f"]:
    pose, on_object = found.T_scene_object, prediction.on_object
    local = transform_points(inverse(pose), prediction.points + seed[None])
    label, _ = nearest(local, part.points[: keypoint_scores.shape[1]])
    row, distance = nearest(local, part.points)
    normals = jnp.matmul(prediction.normals, pose[:3, :3], precision=jax.lax.Precision.HIGHEST)
    cosine = (normals * part.normals[row]).sum(axis=1)
    distance = distance / part.diameter
    near = on_object & (distance <= _NEAR)
    surface = prediction.mask & (distance <= _SURFACE) & (cosine > _ALIKE)
    columns = {
        "surface": score,
        **_of_picture(pose, surfels, image, part.diameter, config),
        "fit": _mean(near, on_object),
        "rms_error": jnp.where(near.any(), jnp.sqrt(_mean(distance**2, near)), _NEAR),
        "inlier_share": found.score,
        "log_inliers": jnp.log1p(found.num_inliers.astype(jnp.float32)),
        "likelihood": _mean(jnp.take_along_axis(keypoint_scores, label[:, None], axis=1)[:, 0], on_object),
        "straight": _mean(cosine, on_object & (distance <= _SURFACE)),
        "covered": _mean(on_object, surface),
        "certainty": _mean(keypoint_scores.max(axis=1), on_object),
        "object_share": _mean(on_object, prediction.mask),
        VERIFIED: jnp.float32(0),
    }
    return jnp.stack([columns[name] for name in EVIDENCE])


def _of_picture(
    pose: Pose, surfels: Surfels, image: DepthImage, diameter: Scalar, config: DepthAgreementConfig
) -> dict[str, Scalar]:
    return {
        **depth_agreement(pose, surfels, image, diameter, config)._asdict(),
        **picture_agreement(pose, surfels, image, diameter)._asdict(),
        **surroundings(pose, surfels, image, diameter)._asdict(),
    }


def _mean(values: Array, where: Bool[Array, " n"]) -> Scalar:
    """Return the mean over some rows, zero of none."""
    chosen = jnp.where(where, values.astype(jnp.float32), 0)
    return chosen.sum() / jnp.maximum(where.sum(dtype=jnp.int32), 1).astype(jnp.float32)


def picture_columns(
    T_camera_object: Pose, surfels: Surfels, image: DepthImage, diameter: Scalar, config: DepthAgreementConfig
) -> Float[Array, " f"]:
    """Return what the depth image shows of a pose, in the order of PICTURE_EVIDENCE."""
    columns = _of_picture(T_camera_object, surfels, image, diameter, config)
    return jnp.stack([columns[name] for name in PICTURE_EVIDENCE])


gather_evidence = kept("config")(evidence_on)
