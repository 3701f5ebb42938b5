"""Scans as sensors write them: clouds and depth images, with their invalid values, in one form."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from kmn_jax.checks import InputError
from kmn_jax.data.mesh_files import CLOUD_SUFFIXES, METRES, check_unit, parse_points, read_file
from kmn_jax.data.scene import Camera

DEPTH_SUFFIXES = (".png", ".tif", ".tiff")
ARRAY_SUFFIXES = (".npy", ".npz")
_SATURATED = 65535  # of 16-bit depth: nothing was measured
_MOST_POINTS = 50_000_000


@dataclass(frozen=True)
class Scan:
    """What a sensor at the origin measured, in its frame (x right, y down, z forward for depth images).

    `points` are finite and not the origin. Normals are those of the file, unit, or none.
    """

    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"] | None
    depth: Float32[np.ndarray, "h w"] | None  # zero where nothing was measured
    camera: Camera | None
    unit: str

    def in_unit(self, unit: str) -> Scan:
        """Return the same scan with its lengths in another unit."""
        factor = np.float32(METRES[self.unit] / METRES[check_unit(unit)])
        depth = None if self.depth is None else self.depth * factor
        return Scan(self.points * factor, self.normals, depth, self.camera, unit)


def read_scan(path: str | Path, unit: str, camera: str | Path | None = None) -> Scan:
    """Read a cloud (PLY, PCD, XYZ, NPY, NPZ) or a depth image (PNG, TIFF, NPY, NPZ), whose lengths are in `unit`.

    Arrays are (n, 3), (n, 6) or organised (h, w, 3), (h, w, 6): points, then normals; or (h, w): depth. In an NPZ file
    they are called `points`, `normals` and `depth`, and `K` may hold the intrinsics. Depth needs a camera file, see
    `read_camera`, whose `depth_scale` turns stored values into `unit`. Points that are not finite or at the origin,
    and depths that are zero, not finite or saturated, were not measured and are left out.

    Raises InputError if a file is missing, of another format, truncated, or if nothing in it was measured.
    """
    path, unit = Path(path), check_unit(unit)
    suffix = path.suffix.lower()
    if suffix not in (*CLOUD_SUFFIXES, *DEPTH_SUFFIXES, *ARRAY_SUFFIXES):
        known = ", ".join(dict.fromkeys((*CLOUD_SUFFIXES, *DEPTH_SUFFIXES, *ARRAY_SUFFIXES)))
        raise InputError(
            f"{path}: the format {suffix or 'without a suffix'} is not known for scans: use one of {known}"
        )
    content = read_file(path, "a scan")
    try:
        if suffix in CLOUD_SUFFIXES:
            points, normals = parse_points(content, suffix)
            return _cloud(points, normals, unit)
        if suffix in DEPTH_SUFFIXES:
            return _depth(_image(content), _needed(camera), unit)
        arrays = _arrays(content, suffix)
        if "depth" in arrays:
            given = _needed(camera) if "K" not in arrays or camera is not None else _from_matrix(arrays)
            return _depth(arrays["depth"], given, unit)
        return _cloud(arrays["points"], arrays.get("normals"), unit)
    except InputError as error:
        raise InputError(f"{path} cannot be used: {error}") from None
    except MemoryError:
        raise InputError(f"{path} cannot be used: it does not fit into memory") from None


@dataclass(frozen=True)
class DepthCamera:
    """The intrinsics of a depth image, before its size is known, and what its stored values are multiplied by."""

    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale: float
    size: tuple[int, int] | None  # width, height


def read_camera(path: str | Path) -> DepthCamera:
    """Read intrinsics: JSON with fx, fy, cx, cy or a row-wise `cam_K` of 9 numbers, and perhaps depth_scale and size.

    The centre of the first pixel has the coordinates (0, 0). Raises InputError for anything else.
    """
    path = Path(path)
    try:
        found = json.loads(read_file(path, "a camera file").decode("utf-8"))
        if not isinstance(found, dict):
            raise ValueError("it is no JSON object")
        if "cam_K" in found:
            matrix = [float(value) for value in np.asarray(found["cam_K"], dtype=float).ravel()]
            if len(matrix) != 9:
                raise ValueError(f"cam_K has {len(matrix)} numbers instead of 9")
            numbers = [matrix[0], matrix[4], matrix[2], matrix[5]]
        else:
            numbers = [float(found[name]) for name in ("fx", "fy", "cx", "cy")]
        scale = float(found.get("depth_scale", 1.0))
        size = (int(found["width"]), int(found["height"])) if "width" in found and "height" in found else None
    except KeyError as error:
        raise InputError(f"{path} cannot be used: it has no {error}, give fx, fy, cx and cy, or cam_K") from None
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} cannot be used as a camera: {error}") from None
    return _camera(numbers, scale, size)


def _camera(numbers: list[float], scale: float, size: tuple[int, int] | None) -> DepthCamera:
    if not np.isfinite([*numbers, scale]).all() or min(numbers[:2]) <= 0 or scale <= 0:
        raise InputError(
            f"fx, fy = {numbers[0]}, {numbers[1]} and depth_scale = {scale} must be above zero, and all finite"
        )
    fx, fy, cx, cy = numbers
    return DepthCamera(fx, fy, cx, cy, scale, size)


def _needed(camera: str | Path | None) -> DepthCamera:
    if camera is None:
        raise InputError("it is a depth image, which needs a camera file with fx, fy, cx and cy")
    return read_camera(camera)


def _from_matrix(arrays: dict[str, np.ndarray]) -> DepthCamera:
    matrix = np.asarray(arrays["K"], dtype=float)
    if matrix.shape != (3, 3):
        raise InputError(f"K has shape {matrix.shape}, but must be (3, 3)")
    return _camera([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], 1.0, None)


def _image(content: bytes) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as image:
            values = np.asarray(image)
    except Exception as error:  # each decoder has errors of its own
        raise InputError(f"it is not a readable image ({type(error).__name__})") from None
    if values.ndim != 2 or values.dtype == np.uint8 or values.dtype == bool:
        kind = f"{values.dtype} with {values.shape[2] if values.ndim == 3 else 1} channels"
        raise InputError(f"it holds {kind}, but depth has one channel of 16 bits or more")
    return values


def _arrays(content: bytes, suffix: str) -> dict[str, np.ndarray]:
    try:
        loaded: Any = np.load(io.BytesIO(content), allow_pickle=False)
        arrays = {name: loaded[name] for name in loaded.files} if suffix == ".npz" else {"": loaded}
    except Exception as error:  # zip, header and pickle errors of many kinds
        raise InputError(f"it is not a readable {suffix} file ({type(error).__name__}: {str(error)[:80]})") from None
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise InputError(f"{name or 'it'} does not hold numbers")
    if suffix == ".npz":
        if not arrays.keys() & {"points", "depth"}:
            raise InputError(f"it holds {', '.join(arrays) or 'nothing'}, but neither points nor depth")
        return arrays
    array = arrays[""]
    if array.ndim == 2 and array.shape[1] not in (3, 6):
        return {"depth": array}
    return {"points": array}


def _cloud(points: np.ndarray, normals: np.ndarray | None, unit: str) -> Scan:
    if points.ndim not in (2, 3) or points.shape[-1] not in (3, 6):
        raise InputError(f"its points have shape {points.shape}, but must be (n, 3), (n, 6), (h, w, 3) or (h, w, 6)")
    if points.shape[-1] == 6 and normals is None:
        points, normals = points[..., :3], points[..., 3:]
    rows = points[..., :3].reshape(-1, 3)
    if len(rows) > _MOST_POINTS:
        raise InputError(f"it has {len(rows)} points, more than {_MOST_POINTS}: thin it out")
    if normals is not None and normals.reshape(-1, 3).shape != rows.shape:
        raise InputError(f"its normals have shape {normals.shape}, but its points {points.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        rows = rows.astype(np.float32)
        real = np.isfinite(rows).all(axis=1) & (rows != 0).any(axis=1)
    if not real.any():
        raise InputError(f"none of its {len(rows)} points was measured: all are NaN, infinite or zero")
    return Scan(rows[real], None if normals is None else _unit(normals.reshape(-1, 3)[real]), None, None, unit)


def _unit(normals: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"] | None:
    """Return normals of length one; none if some are missing."""
    with np.errstate(over="ignore", invalid="ignore"):
        normals = normals.astype(np.float32)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        return None
    return (normals / length).astype(np.float32)


def _depth(values: np.ndarray, camera: DepthCamera, unit: str) -> Scan:
    if values.ndim != 2:
        raise InputError(f"its depth has shape {values.shape}, but must be (h, w)")
    height, width = values.shape
    if camera.size is not None and camera.size != (width, height):
        raise InputError(f"it has {width} x {height} pixels, but its camera {camera.size[0]} x {camera.size[1]}")
    measured: Bool[np.ndarray, "h w"] = np.isfinite(values) & (values > 0)
    if values.dtype == np.uint16:
        measured &= values != _SATURATED
    if not measured.any():
        raise InputError(f"none of its {height} x {width} pixels was measured: all are zero, NaN or saturated")
    depth = np.where(measured, values, 0).astype(np.float64) * camera.depth_scale
    rows, columns = np.nonzero(measured)
    z = depth[rows, columns]
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
    with np.errstate(over="ignore"):
        points, depth = points.astype(np.float32), depth.astype(np.float32)
    if not np.isfinite(points).all():
        raise InputError("its depths are too large for float32: use a larger unit of length")
    return Scan(points, None, depth, Camera(camera.fx, camera.fy, camera.cx, camera.cy, width, height), unit)
