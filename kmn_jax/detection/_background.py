"""What of a scene is not background: what lies inside of a known bin, or differs from the empty bin.

All lengths are in one unit, that of the clouds; margins are shares of the object's diameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from kmn_jax.errors import InputError, float_array, positive_scalar, rigid_pose
from kmn_jax.geometry import Camera, depth_to_points, inverse, transform_points
from kmn_jax.simulate import Bin
from kmn_jax.typing import ArrayInput, Mask, Scalar


@dataclass(frozen=True)
class BinMargins:
    """How far from the bin a point must be to count as content, in diameters of the object."""

    floor: float = 0.03  # above the floor
    wall: float = 0.03  # off the walls
    above_rim: float = 1.0  # piles may stand higher than the walls

    def __post_init__(self) -> None:
        if not np.isfinite([self.floor, self.wall, self.above_rim]).all():
            raise InputError(f"bin margins: {self} must be finite")


def inside_bin(
    points: ArrayInput, T_camera_bin: ArrayInput, bin: Bin, diameter: float, margins: BinMargins | None = None
) -> Mask:
    """Return which points (n, 3), given in the camera frame, lie inside of a bin, off its floor and walls.

    Points that are not finite do not. Raises InputError if the margins leave nothing of the bin.
    """
    points = float_array(points, "points", (None, 3), finite=False)
    pose, low, high = _limits(T_camera_bin, bin, diameter, margins)
    return _inside(points, pose, low, high)


def bin_content(
    depth: ArrayInput,
    camera: Camera,
    T_camera_bin: ArrayInput,
    bin: Bin,
    diameter: float,
    margins: BinMargins | None = None,
) -> Bool[Array, "h w"]:
    """Return which pixels of a depth image (h, w) show something inside of a bin; none where nothing was measured."""
    depth = _lengths(depth, "depth", (camera.height, camera.width))
    pose, low, high = _limits(T_camera_bin, bin, diameter, margins)
    points = depth_to_points(depth, jnp.asarray(camera.matrix, depth.dtype))
    inside = _inside(points.reshape(-1, 3), pose, low, high).reshape(depth.shape)
    return inside & jnp.isfinite(depth) & (depth > 0)


def in_front_of_empty(depth: ArrayInput, empty_depth: ArrayInput, diameter: float, margin: float) -> Bool[Array, "h w"]:
    """Return which pixels are nearer than those of the empty bin by more than `margin` diameters.

    Both images (h, w) are of one camera that did not move. Where only the empty bin has no depth, the pixel counts as
    content; combine with `bin_content` if its floor reflects.
    """
    empty_depth = _lengths(empty_depth, "empty_depth", (None, None))
    depth = _lengths(depth, "depth", empty_depth.shape)
    length = _margin(diameter, margin)
    measured, known = (jnp.isfinite(image) & (image > 0) for image in (depth, empty_depth))
    return measured & (~known | (depth < empty_depth - length.astype(depth.dtype)))


def away_from_empty(
    points: ArrayInput, empty_points: ArrayInput, diameter: float, margin: float
) -> Bool[np.ndarray, " n"]:
    """Return which points (n, 3) are farther than `margin` diameters from every point (m, 3) of the empty bin.

    Both clouds are in one frame; the empty one must be dense, as gaps wider than the margin let background through.
    Points that are not finite do not count.
    """
    from scipy.spatial import cKDTree

    points = np.asarray(float_array(points, "points", (None, 3), finite=False))
    empty_points = np.asarray(float_array(empty_points, "empty_points", (None, 3), finite=False))
    length = float(_margin(diameter, margin))
    empty_points = empty_points[np.isfinite(empty_points).all(axis=1)]
    if not len(empty_points):
        raise InputError("empty_points holds no finite point: give a cloud of the empty bin")
    finite = np.isfinite(points).all(axis=1)
    away = np.zeros(len(points), dtype=bool)
    # The bound, which the search itself leaves out, only saves time.
    nearest, _ = cKDTree(empty_points).query(points[finite], distance_upper_bound=1.01 * length)
    away[finite] = nearest > length
    return away


def _lengths(depth: ArrayInput, name: str, shape: tuple[int | None, ...]) -> Float[Array, "h w"]:
    """Return a depth image of lengths, which whole numbers, as sensors store them, are not."""
    array = float_array(depth, name, shape, finite=False)
    given = depth if isinstance(depth, jax.Array) else np.asarray(depth)
    if jnp.issubdtype(given.dtype, jnp.integer):
        raise InputError(
            f"{name} holds whole numbers, of which it is not known how long they are: give lengths instead"
        )
    return array


def _margin(diameter: float, margin: float) -> Scalar:
    length = positive_scalar(diameter, "diameter")
    if not 0 < margin < float("inf"):
        raise InputError(f"margin is {margin}, but must be above zero and finite, in diameters")
    return length * margin


def _limits(
    T_camera_bin: ArrayInput, bin: Bin, diameter: float, margins: BinMargins | None
) -> tuple[Float[Array, "4 4"], Float[Array, "3"], Float[Array, "3"]]:
    margins = margins or BinMargins()
    pose, length = rigid_pose(T_camera_bin, "T_camera_bin"), float(positive_scalar(diameter, "diameter"))
    low = np.array([-bin.length / 2, -bin.width / 2, 0]) + length * np.array(
        [margins.wall, margins.wall, margins.floor]
    )
    high = np.array([bin.length / 2, bin.width / 2, bin.height])
    high += length * np.array([-margins.wall, -margins.wall, margins.above_rim])
    if not (low < high).all():
        raise InputError(f"the margins leave nothing of the bin, which is {bin.length} x {bin.width} x {bin.height}")
    return pose, jnp.asarray(low, pose.dtype), jnp.asarray(high, pose.dtype)


@partial(jax.jit, inline=True)
def _inside(
    points: Float[Array, "n 3"], T_camera_bin: Float[Array, "4 4"], low: Float[Array, "3"], high: Float[Array, "3"]
) -> Mask:
    local = transform_points(inverse(T_camera_bin), points)
    return ((local > low[None, :]) & (local < high[None, :])).all(axis=1)
