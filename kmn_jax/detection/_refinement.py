"""Poses refined on all points around them, and against the ones they are mistaken for.

Parts that are nearly symmetric are found the wrong way round, as few points tell. So each found pose is compared with
its turns by quarters and halves about the part's main axes. Those that the depth image does not clearly speak against,
once roughly refined, are refined as the pose itself is.

What is refined is the surface that faces the sensor at the pose and that the rest of the part does not hide: measured
points near a thin wall would else be drawn to both of its sides.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from kmn_jax.detection._depth_agreement import DepthAgreementConfig, DepthImage, depth_agreement
from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._mapping import map_rows
from kmn_jax.geometry import (
    Crop,
    PaddedCloud,
    SmoothConfig,
    compose,
    crop_around,
    even_rows,
    inverse,
    nearest,
    spread_rows,
    transform_points,
    with_normals,
)
from kmn_jax.pose import IcpConfig, icp
from kmn_jax.programs import kept
from kmn_jax.simulate import SplatConfig, Surfels, visible_by_splatting
from kmn_jax.typing import Pose, PRNGKey, Scalar

ALTERNATIVES = 2  # turned poses that are refined, too
MARGIN = 0.1  # by which the depth image may speak against a turned pose before it is refined
_ALIKE = 0.3  # cosine of normals, for a point that may lie on a pose's surface
_CROP_POINTS, _NORMALS = 2048, 768  # around the pose's seed, and of these with normals
_NORMAL_RADIUS = 0.06  # diameters, of normals without smoothing
_REACH = 0.1  # diameters, between points and the pose's surface
_SURFELS = 512  # of the part, which are refined, and by which turns are compared with the depth image and the crop
_SIGHT = SplatConfig(resolution=64)  # of the part alone
_ICP, _ICP_POINTS = IcpConfig(iterations=15), 256
_ROUGH_TURNS = 4  # the best turns as they are, which are roughly refined
_ROUGH_ICP, _ROUGH_POINTS = IcpConfig(iterations=6, distance_gate=0.2), 128
_RAW_TOLERANCE = 0.1  # diameters, of depths, for turns as they are: the pose is not exact
_TOLERANCE = 0.05  # the same, once they are roughly refined


def refined_forms(
    pose: Pose,
    crop: Crop,
    part: DevicePart,
    image: DepthImage,
    smooth: SmoothConfig | None,
    agreement: DepthAgreementConfig,
    margin: float = MARGIN,
) -> tuple[Float[Array, "a 4 4"], Bool[Array, " a"]]:
    """Return a pose and turned forms of it, refined on the points of a crop around it, and which of them there are.

    Poses are in the camera's frame. The first form is the pose itself.
    """
    surfels, diameter = part.surfels, part.arrays.diameter
    few = Surfels(surfels.points[:_SURFELS], surfels.normals[:_SURFELS], surfels.area)
    place = jnp.arange(_NORMALS, dtype=jnp.int32)
    chosen = even_rows(place, jnp.maximum(crop.mask.sum(dtype=jnp.int32), _NORMALS), _NORMALS)
    mask = crop.mask[chosen]
    points, normals = with_normals(
        crop.points[chosen], mask, crop.points, crop.mask, -crop.seed, diameter, _NORMAL_RADIUS, smooth
    )
    shown = points + crop.seed[None]

    def score(pose: Pose, tolerance: float) -> Scalar:
        seen = depth_agreement(pose, few, image, diameter, replace(agreement, tolerance=tolerance))
        return seen.explained - seen.violated

    def refined(pose: Pose, count: int, settings: IcpConfig) -> Pose:
        seen = visible_by_splatting(few, pose[None], jnp.ones(1, dtype=bool), image.camera, None, _SIGHT).mask
        to_object = inverse(pose)
        row, distance = nearest(transform_points(to_object, shown), few.points, seen)
        turned = jnp.matmul(normals, to_object[:3, :3].T, precision=jax.lax.Precision.HIGHEST)
        cosine = (turned * few.normals[row]).sum(axis=1)
        rows, there = spread_rows(mask & (distance <= _REACH * diameter) & (cosine > _ALIKE), count)
        fine = icp(
            few.points,
            shown[rows],
            pose,
            diameter,
            scene_normals=normals[rows],
            object_mask=seen,
            scene_mask=there,
            config=settings,
            object_normals=few.normals,
        )
        return fine.T_scene_object

    unlikely = jnp.float32(-jnp.inf)
    turned = map_rows(lambda turn: compose(pose, turn), part.turns)

    def raw_score(turned: Pose, is_rival: Bool[Array, ""]) -> Scalar:
        return jax.lax.cond(is_rival, lambda: score(turned, _RAW_TOLERANCE), lambda: unlikely)

    def roughly_refined(start: Pose, there: Bool[Array, ""]) -> Pose:
        return jax.lax.cond(there, lambda: refined(start, _ROUGH_POINTS, _ROUGH_ICP), lambda: start)

    hope, rows = jax.lax.top_k(map_rows(raw_score, turned, part.is_rival), _ROUGH_TURNS)
    rough = map_rows(roughly_refined, turned[rows], jnp.isfinite(hope))
    scores = map_rows(lambda pose: score(pose, _TOLERANCE), jnp.concatenate([pose[None], rough]))
    best, rows = jax.lax.top_k(jnp.where(jnp.isfinite(hope), scores[1:], unlikely), ALTERNATIVES)
    there = jnp.concatenate([jnp.ones(1, dtype=bool), best >= scores[0] - margin])

    def finish(start: Pose, there: Bool[Array, ""]) -> Pose:
        return jax.lax.cond(there, lambda: refined(start, _ICP_POINTS, _ICP), lambda: start)

    return map_rows(finish, jnp.concatenate([pose[None], rough[rows]]), there), there


def refine_one(
    pose: Pose,
    row: Int[Array, ""],
    key: PRNGKey,
    part: DevicePart,
    cloud: PaddedCloud,
    image: DepthImage,
    smooth: SmoothConfig | None,
    agreement: DepthAgreementConfig,
) -> tuple[Float[Array, "a 4 4"], Bool[Array, " a"]]:
    """Return the refined forms of a pose that was found around the point in a row of a cloud."""
    crop = _crop(key, cloud, row, part.arrays.diameter, _CROP_POINTS, 1)
    return _forms(pose, crop, part, image, smooth, agreement)


@partial(jax.jit, static_argnames=("smooth", "agreement"))
def refine_many(
    poses: Float[Array, "k 4 4"],
    rows: Int[Array, " k"],
    keys: UInt32[Array, "k 2"],
    part: DevicePart,
    cloud: PaddedCloud,
    image: DepthImage,
    smooth: SmoothConfig | None,
    agreement: DepthAgreementConfig,
) -> tuple[Float[Array, "k a 4 4"], Bool[Array, "k a"]]:
    """Return what `refine_one` does of many poses."""

    def one(pose: Pose, row: Int[Array, ""], key: PRNGKey) -> tuple[Float[Array, "a 4 4"], Bool[Array, " a"]]:
        return refine_one(pose, row, key, part, cloud, image, smooth, agreement)

    return jax.vmap(one)(poses, rows, jax.random.wrap_key_data(keys))


_crop = kept("num_points", "min_points", results=(Crop,))(crop_around)
_forms = kept("smooth", "agreement", "margin")(refined_forms)
