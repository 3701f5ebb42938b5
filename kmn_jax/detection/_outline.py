"""The outline of an object at a pose against the measured surface: does the surface end where the object does?

Inside of its outline, a pose sunk into a floor or a wall agrees with the depth image as well as a right one. But the
surface goes on beyond the outline as if nothing were there.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.detection._depth_agreement import DepthAgreementConfig, DepthImage, farthest_at
from kmn_jax.geometry import transform_points
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, Scalar


class OutlineAgreement(NamedTuple):
    """Shares of the outline inside of the image; the rest is hidden."""

    open: Scalar  # something farther away was measured beyond it, or nothing, as where the background is cut away
    level: Scalar  # the measured surface goes on beyond it


def outline_agreement(
    T_camera_object: Pose, surfels: Surfels, image: DepthImage, diameter: Scalar, config: DepthAgreementConfig
) -> OutlineAgreement:
    """Compare the outline of an object at a pose with a depth image in the same unit, zero where nothing was measured.

    The outline is the cells of a grid over the object's picture that are two away from it; holes have one, too.
    """
    depth, camera = image
    points = transform_points(T_camera_object, surfels.points)
    normals = jnp.matmul(surfels.normals, T_camera_object[:3, :3].T, precision=jax.lax.Precision.HIGHEST)
    facing = ((points * normals).sum(axis=1) < 0) & (points[:, 2] > 0)
    some = facing.any()
    nearest = jnp.where(some, jnp.where(facing, points[:, 2], jnp.inf).min(), 1)
    z = jnp.where(facing, points[:, 2], nearest)
    directions = points[:, :2] / z[:, None]
    low, high = (
        jnp.where(some, bound(jnp.where(facing[:, None], directions, worst), axis=0), 0)
        for bound, worst in ((jnp.min, jnp.inf), (jnp.max, -jnp.inf))
    )
    # No finer than pixels, nor than surfels are apart, so that there is one in or next to each cell of the surface.
    spacing = jnp.sqrt(surfels.area / surfels.points.shape[0])
    finest = jnp.maximum(spacing / nearest, 1 / camera.fx)
    pitch = jnp.maximum((high - low).max() / (config.outline_cells - 1), finest)
    size = config.outline_cells + 4  # two more on each side
    place = jnp.round((directions - low[None]) / pitch).astype(jnp.int32) + 2
    index = jnp.where(facing, place[:, 1] * size + place[:, 0], size * size)
    front = jnp.full(size * size, jnp.inf).at[index].min(z, mode="drop").reshape(size, size)
    edge = _farthest_around(front)
    beyond = _farthest_around(edge)
    outline = jnp.isfinite(beyond) & ~jnp.isfinite(edge)
    steps = (jnp.arange(size, dtype=jnp.float32) - 2) * pitch
    u, v = jnp.meshgrid(low[0] + steps, low[1] + steps)
    column, row = camera.fx * u + camera.cx, camera.fy * v + camera.cy
    shown = outline & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    measured = farthest_at(depth, camera, u.reshape(-1), v.reshape(-1), config.window).reshape(size, size)
    gap = measured - beyond
    count = jnp.maximum(shown.sum(dtype=jnp.int32), 1).astype(jnp.float32)
    tolerance = config.tolerance * diameter

    def share(which: Bool[Array, "s s"]) -> Scalar:
        return (shown & which).sum(dtype=jnp.int32).astype(jnp.float32) / count

    return OutlineAgreement(
        share((gap > tolerance) | (measured == 0)), share((jnp.abs(gap) <= tolerance) & (measured > 0))
    )


def _farthest_around(front: Float[Array, "s s"]) -> Float[Array, "s s"]:
    """Return the depth of cells; where there is none, the farthest of the eight cells around."""
    known = jnp.where(jnp.isfinite(front), front, -jnp.inf)
    most = jax.lax.reduce_window(known, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME")
    return jnp.where(jnp.isfinite(front), front, jnp.where(jnp.isfinite(most), most, jnp.inf))
