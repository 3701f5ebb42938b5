"""What a bin scene is: a bin, an object's poses in it, and a camera above. Plain data, lengths in one unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from kmn_jax.checks import InputError


@dataclass(frozen=True)
class Camera:
    """Pinhole camera: x right, y down, z forward; the centre of the first pixel has the coordinates (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        numbers = np.array([self.fx, self.fy, self.cx, self.cy], dtype=float)
        if not np.isfinite(numbers).all() or self.fx <= 0 or self.fy <= 0:
            raise InputError(f"camera: fx = {self.fx}, fy = {self.fy} must be above zero, and all numbers finite")
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: an image of {self.width} x {self.height} pixels is empty")

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The intrinsics, pixels from camera coordinates."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=float)


@dataclass(frozen=True)
class Bin:
    """A box without a lid. Its frame: origin at the centre of the floor's upper side, z up, x along `length`.

    `length`, `width` and `height` are inner, `thickness` is that of floor and walls, which lie outside of them.
    """

    length: float
    width: float
    height: float
    thickness: float

    def __post_init__(self) -> None:
        sizes = (self.length, self.width, self.height, self.thickness)
        if not np.isfinite(sizes).all() or min(sizes) <= 0:
            raise InputError(f"bin: length, width, height and thickness are {sizes}, but must be above zero")


@dataclass(frozen=True)
class BinScene:
    """Copies of one object at rest in a bin, seen by one camera. Frames: object, bin, camera."""

    bin: Bin
    T_bin_object: Float[np.ndarray, "n 4 4"]
    camera: Camera
    T_camera_bin: Float[np.ndarray, "4 4"]

    @property
    def T_camera_object(self) -> Float[np.ndarray, "n 4 4"]:
        """The poses of the copies in the camera frame."""
        return self.T_camera_bin @ self.T_bin_object


def measured_points(depth: Float[np.ndarray, "h w"], camera: Camera) -> Float32[np.ndarray, "n 3"]:
    """Return the points of the pixels that have a depth, row by row, in the camera frame and the depth's unit.

    It stays on the host, as threads read frames beside a device.
    """
    rows, columns = np.nonzero(depth > 0)
    z = depth[rows, columns].astype(np.float64)
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
    return points.astype(np.float32)
