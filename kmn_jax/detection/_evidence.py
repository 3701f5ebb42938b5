"""What speaks for and against a pose: what the depth image shows of it, and what the network says of its crop."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.detection._contour import contour
from kmn_jax.detection._search import CropFeatures, Hypotheses, Predictions, each
from kmn_jax.detection._verify import VerifyConfig, agreement
from kmn_jax.geometry import Intrinsics, inverse, nearest, transform_points
from kmn_jax.objects import PartArrays
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Scalar

EVIDENCE = (
    "explained",  # of the picture area of the pose, see `Agreement`
    "violated",
    "occluded",
    "unknown",
    "sunk",
    "confirmed",  # explained, of what was explained or violated
    "fit",  # share of the points on the object that are near to the pose's surface
    "rms_error",  # of these, in diameters
    "inlier_share",  # of the matches
    "log_inliers",
    "likelihood",  # mean, over the points on the object, of the probability of the keypoint nearest at the pose
    "straight",  # mean cosine of the two surfaces' normals where they meet
    "covered",  # share of the crop's points on the pose's surface that are on the object
    "certainty",  # mean probability of the likeliest keypoint
    "object_share",  # of the crop's points that are on the object
    "open",  # share of the pose's outline, see `Contour`
    "level",
    "open_explained",  # products: an explained pose and a hidden one end differently
    "open_occluded",
)
_AGAINST = {"violated", "occluded", "unknown", "sunk", "rms_error", "level"}
# Whether more of it speaks for a pose, or against it, or either, as for a part that fills its crop or does not.
SIGNS = {name: -1 if name in _AGAINST else 0 if name == "object_share" else 1 for name in EVIDENCE}
_NEAR = 0.1  # diameters
_SURFACE = 0.05  # diameters; points so near to a surface with a normal like it lie on it
_ALIKE = 0.5  # cosine


class Sight(NamedTuple):
    """A depth image, zero where nothing was measured, and its camera."""

    depth: Float[Array, "h w"]
    camera: Intrinsics


def evidence_of(
    found: Hypotheses,
    said: Predictions,
    crops: CropFeatures,
    part: PartArrays,
    surfels: Surfels,
    sight: Sight,
    config: VerifyConfig,
) -> Float[Array, "s h f"]:
    """Return the evidence on each pose, in the order of EVIDENCE; zeros for crops without any pose."""

    def of_crop(found: Hypotheses, said: Predictions, crop: CropFeatures) -> Float[Array, "h f"]:
        return jax.lax.map(lambda pose: _evidence(pose, said, crop, part, surfels, sight, config), found)

    return each(of_crop, crops.valid & found.found.any(axis=1), found, said, crops)


def _evidence(
    found: Hypotheses,
    said: Predictions,
    crop: CropFeatures,
    part: PartArrays,
    surfels: Surfels,
    sight: Sight,
    config: VerifyConfig,
) -> Float[Array, " f"]:
    outline = contour(found.T_scene_object, surfels, sight.depth, sight.camera, part.diameter, config)
    seen = agreement(found.T_scene_object, surfels, sight.depth, sight.camera, part.diameter, config)
    local = transform_points(inverse(found.T_scene_object), crop.points + crop.seed[None])
    label, _ = nearest(local, part.points[: said.scores.shape[1]])
    row, distance = nearest(local, part.points)
    normals = jnp.matmul(crop.normals, found.T_scene_object[:3, :3], precision=jax.lax.Precision.HIGHEST)
    cosine = (normals * part.normals[row]).sum(axis=1)
    distance = distance / part.diameter
    near = said.on_object & (distance <= _NEAR)
    surface = crop.mask & (distance <= _SURFACE) & (cosine > _ALIKE)
    columns = {
        **seen._asdict(),
        **outline._asdict(),
        "open_explained": outline.open * seen.explained,
        "open_occluded": outline.open * seen.occluded,
        "confirmed": seen.explained / jnp.maximum(seen.explained + seen.violated, 1e-6),
        "fit": _mean(near, said.on_object),
        "rms_error": jnp.where(near.any(), jnp.sqrt(_mean(distance**2, near)), _NEAR),
        "inlier_share": found.inlier_share,
        "log_inliers": jnp.log1p(found.num_inliers.astype(jnp.float32)),
        "likelihood": _mean(jnp.take_along_axis(said.scores, label[:, None], axis=1)[:, 0], said.on_object),
        "straight": _mean(cosine, said.on_object & (distance <= _SURFACE)),
        "covered": _mean(said.on_object, surface),
        "certainty": _mean(said.scores.max(axis=1), said.on_object),
        "object_share": _mean(said.on_object, crop.mask),
    }
    return jnp.stack([columns[name] for name in EVIDENCE])


def _mean(values: Array, where: Bool[Array, " n"]) -> Scalar:
    """Return the mean over some rows, zero of none."""
    chosen = jnp.where(where, values.astype(jnp.float32), 0)
    return chosen.sum() / jnp.maximum(where.sum(dtype=jnp.int32), 1).astype(jnp.float32)
