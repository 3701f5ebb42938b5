"""Poses that stand against the ones that they are mistaken for, by all that was measured of the part.

What tells a pose from such a one may be as small as a hole: refinement compares few points, and few turns. Here all
turned forms are compared, the best of them once they are moved onto what was measured, by as fine a tolerance as the
scan allows. Measured points count where the surface is expected at their depth, the same points for all forms: of a
sparse cloud it is chance which of the surface's own points are hit. Against a form speaks what the sensor saw through.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from kmn_jax.detection._depth_agreement import DepthImage, measured_at
from kmn_jax.detection._device_part import DevicePart
from kmn_jax.detection._mapping import call_rows, map_real, map_rows
from kmn_jax.detection._polish import polished
from kmn_jax.geometry import PaddedCloud, compose, rotate_vectors, smallest_at, spread_rows, transform_points
from kmn_jax.programs import kept
from kmn_jax.simulate import SplatConfig, Surfels, picture_by_splatting
from kmn_jax.typing import Pose, Scalar

_SIGHT, _ROUGH_SIGHT = SplatConfig(resolution=128), SplatConfig(resolution=64)  # of the part alone
_POINTS = 2048  # measured ones, in directions in which the part may be
_ROUGH_SURFELS, _ROUGH_SHARE = 512, 4  # of the part, and one measured point in so many: for forms as they are
_MOVED = 4  # turned forms that are moved onto what was measured, those that agree best as they are
_ROUNDS = 2  # of moving
_SLACK = 0.2  # by which such a one may agree less than the pose itself
_GATE = 0.05  # diameters, between the surface and what was measured of it
_SPREADS, _LEAST_TOLERANCE = 3, 0.02  # medians of the distances; diameters
_MARGIN = 0.01  # by which another form has to agree better


class _Sight(NamedTuple):
    """A part at a pose beside what was measured; lengths are in diameters."""

    gap: Float[Array, " p"]  # from the surface to each measured point, along the view; infinite beside the part
    apart: Float[Array, " m"]  # from what was measured to each point of the surface, along its normal
    near: Bool[Array, " m"]  # where what was measured may be of that point
    behind: Float[Array, " m"]  # by how much what was measured lies behind it
    area: Float[Array, " m"]  # of it in the picture; zero where it is hidden or nothing was measured


def disambiguated(pose: Pose, part: DevicePart, cloud: PaddedCloud, image: DepthImage) -> tuple[Pose, Bool[Array, ""]]:
    """Return the form of a pose T_camera_object that what was measured clearly prefers, and whether it is another one.

    The other forms are those that the part is mistaken for, `DevicePart.turns`. The pose itself is returned as it is,
    unless one of them agrees better by a margin.
    """
    surfels, diameter = part.surfels, part.arrays.diameter
    measured = _in_directions_of(pose, part, cloud)
    few = Surfels(surfels.points[:_ROUGH_SURFELS], surfels.normals[:_ROUGH_SURFELS], surfels.area)
    some = PaddedCloud(measured.points[::_ROUGH_SHARE], measured.mask[::_ROUGH_SHARE])

    def sight(pose: Pose, surfels: Surfels, measured: PaddedCloud, config: SplatConfig) -> _Sight:
        seen, depth = picture_by_splatting(surfels, pose, measured.points, image.camera, config)
        points = transform_points(pose, surfels.points)
        places, there = measured_at(image, points)
        apart = (points - places) / diameter
        there = there & seen.mask
        return _Sight(
            jnp.where(measured.mask & jnp.isfinite(depth), (measured.points[:, 2] - depth) / diameter, jnp.inf),
            (rotate_vectors(pose, surfels.normals) * apart).sum(axis=1),
            there & ((apart**2).sum(axis=1) <= _GATE**2),
            -apart[:, 2],
            jnp.where(there, seen.picture_area, 0),
        )

    def moved(start: Pose) -> tuple[Pose, _Sight]:
        end = jax.lax.fori_loop(0, _ROUNDS, lambda _, pose: polished(pose, part, image), start)
        return end, sight(end, surfels, measured, _SIGHT)

    def roughly(start: Pose) -> _Sight:
        return sight(start, few, some, _ROUGH_SIGHT)

    starts = jnp.concatenate([pose[None], map_rows(lambda turn: compose(pose, turn), part.turns)])
    hope = _agreements(map_real(roughly, _after_itself(part.is_rival), starts), jnp.float32(_GATE))
    hope, rows = jax.lax.top_k(jnp.where(part.is_rival & (hope[1:] >= hope[0] - _SLACK), hope[1:], -jnp.inf), _MOVED)
    there = _after_itself(jnp.isfinite(hope))
    forms, sights = map_real(moved, there, jnp.concatenate([pose[None], starts[1:][rows]]))
    distance = jnp.where(sights.near[0], jnp.abs(sights.apart[0]), jnp.inf)
    middle = smallest_at(distance, sights.near[0].sum(dtype=jnp.int32) // 2)
    tolerance = jnp.clip(_SPREADS * jnp.where(jnp.isfinite(middle), middle, 0), _LEAST_TOLERANCE, _GATE)
    found = jnp.where(there, _agreements(sights, tolerance), -jnp.inf).at[0].add(_MARGIN)
    best: Int[Array, ""] = found.argmax()
    return jnp.where(best > 0, forms[best], pose), best > 0


def _agreements(of: _Sight, tolerance: Scalar) -> Float[Array, " a"]:
    """Return which share of the first form's own points each explains, less the share of it that was seen through."""
    expected = jnp.maximum(jnp.isfinite(of.gap[0]).sum(dtype=jnp.float32), 1)
    explained = jnp.maximum(1 - (of.gap / tolerance) ** 2, 0).sum(axis=1) / expected
    area = jnp.maximum(of.area.sum(axis=1), jnp.finfo(jnp.float32).tiny)
    return explained - jnp.where(of.behind >= 2 * tolerance, of.area, 0).sum(axis=1) / area


def _after_itself(others: Bool[Array, " a"]) -> Bool[Array, " b"]:
    """Return flags of forms of a pose after that of the pose itself."""
    return jnp.concatenate([jnp.ones(1, dtype=bool), others])


def _in_directions_of(pose: Pose, part: DevicePart, cloud: PaddedCloud) -> PaddedCloud:
    """Return measured points, evenly chosen of those that lie before, on or behind the ball that holds the part."""
    points = part.surfels.points
    middle = points.mean(axis=0)
    radius = jnp.sqrt(((points - middle[None]) ** 2).sum(axis=1).max())
    centre = transform_points(pose, middle[None])
    length = jnp.sqrt(jnp.maximum((cloud.points**2).sum(axis=1), jnp.finfo(jnp.float32).tiny))
    aside = jnp.sqrt((jnp.cross(cloud.points, centre) ** 2).sum(axis=1)) / length
    rows, there = spread_rows(cloud.mask & (cloud.points[:, 2] > 0) & (aside <= radius), _POINTS)
    return PaddedCloud(cloud.points[rows], there)


disambiguate_one = kept()(disambiguated)


_disambiguate_many = jax.jit(jax.vmap(disambiguated, in_axes=(0, None, None, None)))


def disambiguate(
    T_camera_object: Float32[np.ndarray, "k 4 4"], part: DevicePart, cloud: PaddedCloud, image: DepthImage
) -> tuple[Float32[np.ndarray, "k 4 4"], Bool[np.ndarray, " k"]]:
    """Return what `disambiguated` does of poses."""
    if not len(T_camera_object) or not np.asarray(part.is_rival).any():
        return T_camera_object, np.zeros(len(T_camera_object), dtype=bool)
    given = part, cloud, image
    return call_rows(
        lambda pose: disambiguate_one(pose, *given), lambda poses: _disambiguate_many(poses, *given), T_camera_object
    )
