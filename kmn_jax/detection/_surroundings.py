"""What lies around an object at a pose, up to half a diameter beyond its picture: is there room for it, and no more?

The outline of a picture is two cells wide. Whether an object lies on a floor or in it, on top of a pile or below it, is
told by more than that: so a coarser grid reaches farther, and what is measured in it is compared with all of the
object's surface, also with what is turned away. The grid is square: beside a long object it reaches farther.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from kmn_jax.detection._cells import fit_plane, grown, places_of
from kmn_jax.detection._depth_agreement import DepthImage, depth_at, in_image
from kmn_jax.geometry import transform_points
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, Scalar

_CELLS = 32  # of the grid, along each side
# Lengths are in diameters of the object.
_MARGIN = 0.5  # beyond the longer sides of the picture's box
_BESIDE = 0.6  # what lies so much nearer or farther than all of the object is not beside it
_APART, _FAR = 0.03, 0.3  # in depth, from all of the object
_BELOW = 0.02  # the plane around it: so far below it is all below
_MOST = 0.5  # of a cell's distance from that plane that counts
_HIGHEST = 1.0  # above or below it


class Surroundings(NamedTuple):
    """Shares of the cells around an object; then how its surface lies to the plane of those that are about as far.

    Cells that the object would cover, that are next to these, or outside of the image, are left out. Heights are
    towards the camera, in diameters; zero where nothing is measured beside the object. All is zero of a pose that is
    not wholly in front of the camera.
    """

    around_unknown: Scalar  # nothing was measured
    around_in_front: Scalar  # nearer than all of the object, by 3% of the diameter
    around_behind: Scalar  # farther than all of it
    around_far_behind: Scalar  # by 30%
    around_buried: Scalar  # of the whole surface: below the plane; by less than 2% it counts in part
    around_raised: Scalar  # mean height of the surface
    around_lowest: Scalar  # the least height of a point
    around_highest: Scalar
    around_uneven: Scalar  # root mean square of how far what is measured lies from the plane


def surroundings(T_camera_object: Pose, surfels: Surfels, image: DepthImage, diameter: Scalar) -> Surroundings:
    """Compare an object at a pose with a depth image in the same unit, zero where nothing was measured."""
    points = transform_points(T_camera_object, surfels.points)
    z = jnp.maximum(points[:, 2], 1e-6 * diameter)
    nearest, farthest = z.min(), z.max()
    directions = points[:, :2] / z[:, None]
    low, high = directions.min(axis=0), directions.max(axis=0)
    pitch = ((high - low).max() + 2 * _MARGIN * diameter / nearest) / (_CELLS - 1)
    first = (low + high) / 2 - pitch * (_CELLS - 1) / 2
    places = (directions - first[None]) / pitch
    steps = jnp.arange(_CELLS, dtype=jnp.float32) * pitch
    u, v = jnp.meshgrid(first[0] + steps, first[1] + steps)
    depth = depth_at(image, u, v)
    cells = jnp.clip(jnp.round(places), 0, _CELLS - 1).astype(jnp.int32)
    covered = grown(jnp.zeros((_CELLS, _CELLS), dtype=bool).at[cells[:, 1], cells[:, 0]].set(True))
    outside = ~covered & in_image(image, u, v) & (points[:, 2] > 0).all()
    there = outside & (depth > 0)
    beside = there & (depth > nearest - _BESIDE * diameter) & (depth < farthest + _BESIDE * diameter)

    def share(which: Bool[Array, "s s"]) -> Scalar:
        return (outside & which).sum(dtype=jnp.float32) / jnp.maximum(outside.sum(dtype=jnp.float32), 1)

    plane = fit_plane(depth, beside, nearest)
    height = jnp.where(beside.any(), (plane.depth(places[:, 0], places[:, 1]) - z) / diameter, 0)
    uneven = jnp.clip((plane.depth(*places_of(depth)) - depth) / diameter, -_MOST, _MOST)
    squares = jnp.where(beside, uneven**2, 0).sum() / jnp.maximum(beside.sum(dtype=jnp.float32), 1)
    return Surroundings(
        around_unknown=share(depth <= 0),
        around_in_front=share(there & (depth < nearest - _APART * diameter)),
        around_behind=share(there & (depth > farthest + _APART * diameter)),
        around_far_behind=share(there & (depth > farthest + _FAR * diameter)),
        around_buried=jnp.clip(-height / _BELOW, 0, 1).mean(),
        around_raised=jnp.clip(height, -_HIGHEST, _HIGHEST).mean(),
        around_lowest=jnp.clip(height.min(), -_HIGHEST, _HIGHEST),
        around_highest=jnp.clip(height.max(), -_HIGHEST, _HIGHEST),
        around_uneven=jnp.sqrt(squares),
    )
