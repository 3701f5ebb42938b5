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
from kmn_jax.detection._mapping import call_rows, map_real
from kmn_jax.detection._polish import polished
from kmn_jax.geometry import PaddedCloud, compose, rotate_vectors, smallest_at, spread_rows, transform_points
from kmn_jax.programs import kept
from kmn_jax.simulate import SplatConfig, picture_by_splatting
from kmn_jax.typing import Pose, Scalar

_SIGHT = SplatConfig(resolution=128)  # of the part alone
_POINTS = 2048  # measured ones, in directions in which the part may be
_MOVED = 6  # turned forms that are moved onto what was measured, those that agree best as they are
_SLACK = 0.3  # by which such a one may agree less than the pose itself
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


def settled(pose: Pose, part: DevicePart, cloud: PaddedCloud, image: DepthImage) -> tuple[Pose, Bool[Array, ""]]:
    """Return the form of a pose T_camera_object that what was measured clearly prefers, and whether it is another one.

    The other forms are those that the part is mistaken for, `DevicePart.turns`. The pose itself is returned as it is,
    unless one of them agrees better by a margin.
    """
    surfels, diameter = part.surfels, part.arrays.diameter
    measured = _in_directions_of(pose, part, cloud)

    def sight(pose: Pose) -> _Sight:
        seen, depth = picture_by_splatting(surfels, pose, measured.points, image.camera, _SIGHT)
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

    own = sight(polished(pose, part, image))
    expected = jnp.maximum(jnp.isfinite(own.gap).sum(dtype=jnp.float32), 1)
    middle = smallest_at(jnp.where(own.near, jnp.abs(own.apart), jnp.inf), own.near.sum(dtype=jnp.int32) // 2)
    tolerance = jnp.clip(_SPREADS * jnp.where(jnp.isfinite(middle), middle, 0), _LEAST_TOLERANCE, _GATE)

    def agreement(of: _Sight, tolerance: Scalar | float) -> Scalar:
        """Return which share of the points that belong to the pose itself is explained, less that seen through."""
        explained = jnp.maximum(1 - (of.gap / tolerance) ** 2, 0).sum() / expected
        area = jnp.maximum(of.area.sum(), jnp.finfo(jnp.float32).tiny)
        return explained - jnp.where(of.behind >= 2 * tolerance, of.area, 0).sum() / area

    def rough(turn: Pose) -> tuple[Pose, Scalar]:
        turned = compose(pose, turn)
        return turned, agreement(sight(turned), _GATE)

    def fine(turned: Pose) -> tuple[Pose, Scalar]:
        moved = polished(polished(turned, part, image), part, image)
        return moved, agreement(sight(moved), tolerance)

    turned, hope = map_real(rough, part.is_rival, part.turns)
    is_hopeful = part.is_rival & (hope >= agreement(own, _GATE) - _SLACK)
    hope, rows = jax.lax.top_k(jnp.where(is_hopeful, hope, -jnp.inf), _MOVED)
    forms, found = map_real(fine, jnp.isfinite(hope), turned[rows])
    found = jnp.where(jnp.isfinite(hope), found, -jnp.inf)
    best: Int[Array, ""] = found.argmax()
    is_other = found[best] > agreement(own, tolerance) + _MARGIN
    return jnp.where(is_other, forms[best], pose), is_other


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


settle_one = kept()(settled)


_settle_many = jax.jit(jax.vmap(settled, in_axes=(0, None, None, None)))


def settle(
    T_camera_object: Float32[np.ndarray, "k 4 4"], part: DevicePart, cloud: PaddedCloud, image: DepthImage
) -> tuple[Float32[np.ndarray, "k 4 4"], Bool[np.ndarray, " k"]]:
    """Return what `settled` does of poses."""
    if not len(T_camera_object) or not np.asarray(part.is_rival).any():
        return T_camera_object, np.zeros(len(T_camera_object), dtype=bool)
    given = part, cloud, image
    return call_rows(lambda pose: settle_one(pose, *given), lambda poses: _settle_many(poses, *given), T_camera_object)
