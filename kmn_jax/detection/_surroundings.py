"""What lies around an object at a pose, up to half a diameter beyond its picture: is there room for it, and no more?

The outline of a picture is two cells wide. Whether an object lies on a floor or in it, on top of a pile or below it, is
told by more than that: so a coarser grid reaches farther, and what is measured in it is compared with all of the
object's surface, also with what is turned away.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.detection._depth_agreement import DepthImage, depth_at
from kmn_jax.detection._linear_fit import fit_linear
from kmn_jax.geometry import transform_points
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, Scalar

_CELLS = 32  # of the grid, along each side
# Lengths are in diameters of the object.
_MARGIN = 0.5  # beyond the picture, on each side
_BESIDE = 0.6  # what lies so much nearer or farther than all of the object is not beside it
_APART, _FAR = 0.03, 0.3  # in depth, from all of the object
_BELOW = 0.02  # the plane around it: so far below it is all below
_MOST = 0.5  # of a cell's distance from that plane that counts
_HIGHEST = 1.0  # above or below it
_FLATTEST = 1e-3  # of the nearest point's closeness: a plane is no farther than its inverse tells


class Surroundings(NamedTuple):
    """Shares of the cells around an object; then how its surface lies to the plane of those that are about as far.

    Cells that the object would cover, or that are next to these, are left out. Heights are towards the camera, in
    diameters; zero where nothing is measured beside the object.
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
    """Compare an object at a pose with what was measured around it, in the same unit; zero where nothing was."""
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
    outside = ~_covered(places)
    there = outside & (depth > 0)
    beside = there & (depth > nearest - _BESIDE * diameter) & (depth < farthest + _BESIDE * diameter)

    def share(which: Bool[Array, "s s"]) -> Scalar:
        return (outside & which).sum(dtype=jnp.float32) / jnp.maximum(outside.sum(dtype=jnp.float32), 1)

    # Over directions, the inverse depths of a plane are linear.
    plane = fit_linear(nearest / jnp.where(beside, depth, nearest), beside)

    def depths(columns: Float[Array, "*c"], rows: Float[Array, "*c"]) -> Float[Array, "*c"]:
        return nearest / jnp.maximum(plane.at(columns, rows), _FLATTEST)

    height = jnp.where(beside.any(), (depths(places[:, 0], places[:, 1]) - z) / diameter, 0)
    rows, columns = (grid.astype(jnp.float32) for grid in jnp.indices(depth.shape))
    uneven = jnp.clip((depths(columns, rows) - depth) / diameter, -_MOST, _MOST)
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


def _covered(places: Float[Array, "m 2"]) -> Bool[Array, "s s"]:
    """Return the cells that points fall into, and those next to them."""
    cells = jnp.clip(jnp.round(places), 0, _CELLS - 1).astype(jnp.int32)
    mask = jnp.zeros((_CELLS + 2, _CELLS + 2), dtype=bool)
    for step in ((u, v) for u in range(3) for v in range(3)):
        mask = mask.at[cells[:, 1] + step[1], cells[:, 0] + step[0]].set(True)
    return mask[1:-1, 1:-1]
