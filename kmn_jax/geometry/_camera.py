"""Pinhole cameras, and the points of depth images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from kmn_jax.errors import InputError
from kmn_jax.typing import Scalar


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


class Intrinsics(NamedTuple):
    """A pinhole camera as numbers that may be traced; see `Camera` for their meaning."""

    fx: Scalar
    fy: Scalar
    cx: Scalar
    cy: Scalar
    width: Scalar
    height: Scalar


def intrinsics(camera: Camera) -> Intrinsics:
    """Return a camera's numbers as float32 scalars."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return Intrinsics(*(jnp.asarray(number, dtype=jnp.float32) for number in numbers))


def measured_points(depth: Float[np.ndarray, "h w"], camera: Camera) -> Float32[np.ndarray, "n 3"]:
    """Return the points of the pixels that have a depth, row by row, in the camera frame and the depth's unit.

    It stays on the host, as threads read frames beside a device.
    """
    rows, columns = np.nonzero(depth > 0)
    z = depth[rows, columns].astype(np.float64)
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
    return points.astype(np.float32)
