"""Depth images as a camera's driver hands them over: arrays with intrinsics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Shaped

from kmn_jax.errors import InputError
from kmn_jax.io._scans import DepthCamera, Scan, depth_scan
from kmn_jax.units import check_unit

# Intrinsics: a matrix (3, 3), its nine numbers row by row, or fx, fy, cx and cy; judged here, with errors of our own.
if TYPE_CHECKING:
    CameraMatrix: TypeAlias = np.ndarray | Sequence[float] | Sequence[Sequence[float]]
else:
    CameraMatrix = Any

_BY_WHOLE_NUMBERS, _BY_FRACTIONS = "mm", "m"  # what drivers and ROS (REP 118) write


def depth_array_scan(depth: Shaped[np.ndarray, "..."], K: CameraMatrix, depth_unit: str | float | None = None) -> Scan:
    """Return the scan of a depth image (h, w) with intrinsics, in the frame of its camera.

    `depth_unit` is the unit of the stored values and of the scan's lengths; by default millimetres of whole numbers and
    metres of fractions. A number is how many metres one step is, such as a RealSense's depth scale; then lengths are
    metres. Zeros, NaN, infinite and saturated values were not measured. Raises InputError if the array is no depth
    image, if the intrinsics are none, or if nothing was measured.
    """
    values = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
    if values.ndim != 2 or values.dtype.kind not in "iuf" or values.dtype.itemsize < 2:
        raise InputError(
            f"the depth image has shape {depth.shape} and dtype {depth.dtype}, but must be (h, w) of 16 bits or more"
        )
    scale = 1.0
    if depth_unit is None:
        unit = _BY_FRACTIONS if values.dtype.kind == "f" else _BY_WHOLE_NUMBERS
    elif isinstance(depth_unit, str):
        unit = check_unit(depth_unit)
    else:
        unit, scale = "m", float(depth_unit)
    camera = _camera(K, scale)
    try:
        return depth_scan(values, camera, unit)
    except InputError as error:
        raise InputError(f"the depth image cannot be used: {error}") from None


def _camera(K: CameraMatrix, scale: float) -> DepthCamera:
    try:
        numbers = np.asarray(K, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape == (4,):
        fx, fy, cx, cy = numbers.tolist()
    elif numbers.shape in ((3, 3), (9,)):
        (fx, skew, cx), (zero, fy, cy), last = numbers.reshape(3, 3).tolist()
        if (skew, zero, *last) != (0, 0, 0, 0, 1):
            raise InputError("K must be fx 0 cx 0 fy cy 0 0 1, row by row: a camera with skew is not supported")
    else:
        raise InputError(f"K has shape {numbers.shape}, but must be a matrix (3, 3), or fx, fy, cx and cy")
    return DepthCamera(fx, fy, cx, cy, scale, None)
