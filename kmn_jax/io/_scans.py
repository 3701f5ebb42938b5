"""Scans as sensors write them: clouds and depth images, with their invalid values, in one form."""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from kmn_jax.errors import InputError, shown
from kmn_jax.geometry import Camera, measured_points
from kmn_jax.io._exr import parse_exr
from kmn_jax.io._images import image_header, read_image
from kmn_jax.io._meshes import CLOUD_SUFFIXES, parse_mesh, read_file
from kmn_jax.io._origin import held
from kmn_jax.limits import check_bytes, check_elements, most_elements, parse_json
from kmn_jax.units import METRES, check_unit

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
ARRAY_SUFFIXES = (".npy", ".npz")
_IMAGE_FORMATS = ("PNG", "TIFF")
_NARROWEST = 16  # columns of a depth image: of fewer, each row is a point, with whatever else is told of it
_SATURATED = 65535  # of 16-bit depth, which some readers return as wider numbers: nothing was measured
_FARTHEST = 1e9  # units: renderers write 1e10 where they see nothing
_DENSEST = 4096  # bytes of pixels from one byte of a file: compression that does more packs no measurement


@dataclass(frozen=True, eq=False)
class Scan:
    """What a sensor at the origin measured, in its frame (x right, y down, z forward for depth images).

    `points` are finite and not the origin; float64 if they lie too far from it for float32, see `held`. Normals are
    those of the file, unit, or none.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"] | None
    depth: Float32[np.ndarray, "h w"] | None  # zero where nothing was measured
    camera: Camera | None
    unit: str

    def in_unit(self, unit: str) -> Scan:
        """Return the same scan with its lengths in another unit."""
        factor = METRES[self.unit] / METRES[check_unit(unit)]
        depth = None if self.depth is None else self.depth * factor
        return Scan(self.points * factor, self.normals, depth, self.camera, unit)


def read_scan(path: str | Path, unit: str, camera: str | Path | None = None) -> Scan:
    """Read a cloud (PLY, PCD, XYZ, NPY, NPZ) or a depth image (PNG, TIFF, EXR, NPY, NPZ), with lengths in `unit`.

    Arrays are (n, 3), (n, 6) or organised (h, w, 3), (h, w, 6): points, then normals; or (h, w): depth. In an NPZ file
    they are called `points`, `normals` and `depth`, and `K` may hold the intrinsics. Of an EXR file its only channel is
    read, or the one called Z or depth. Depth needs a camera file, see `read_camera`, whose `depth_scale` turns stored
    values into `unit`. Points that are not finite, at the origin or beyond 1e9, and depths that are zero, negative,
    not finite, saturated or beyond 1e9, were not measured and are left out.

    Raises InputError if a file is missing, of another format, truncated, or if nothing in it was measured.
    """
    path, unit = Path(path), check_unit(unit)
    suffix = path.suffix.lower()
    if path.is_dir():
        raise InputError(f"{path} is a folder: name a scan")
    if suffix not in (*CLOUD_SUFFIXES, *DEPTH_SUFFIXES, *ARRAY_SUFFIXES):
        known = ", ".join(dict.fromkeys((*CLOUD_SUFFIXES, *DEPTH_SUFFIXES, *ARRAY_SUFFIXES)))
        raise InputError(
            f"{path}: the format {suffix or 'without a suffix'} is not known for scans: use one of {known}"
        )
    content = read_file(path, "a scan")
    try:
        arrays = _arrays(content, suffix, camera is not None)
        if "depth" in arrays and (camera is not None or "K" in arrays or "points" not in arrays):
            if camera is not None:
                intrinsics = read_camera(camera)
            elif "K" in arrays:
                intrinsics = _intrinsics(arrays["K"], "K", 1.0, None)
            else:
                raise InputError("it is a depth image, which needs a camera file with fx, fy, cx and cy")
            return depth_scan(arrays["depth"], intrinsics, unit)
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

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.depth_scale)
        if not np.isfinite([*numbers, self.cx, self.cy]).all() or min(numbers) <= 0:
            raise InputError(
                f"fx, fy = {self.fx}, {self.fy} and depth_scale = {self.depth_scale} must be above zero, and all finite"
            )


def read_camera(path: str | Path) -> DepthCamera:
    """Read intrinsics: JSON with fx, fy, cx, cy or a row-wise `cam_K` of 9 numbers, and perhaps depth_scale and size.

    The centre of the first pixel has the coordinates (0, 0). Raises InputError for anything else.
    """
    path = Path(path)
    content = read_file(path, "a camera file")
    try:
        found = parse_json(content.decode("utf-8"))
        if not isinstance(found, dict):
            raise ValueError("it is no JSON object")
        scale = float(found.get("depth_scale", 1.0))
        size = (int(found["width"]), int(found["height"])) if "width" in found and "height" in found else None
        if "cam_K" in found:
            matrix = np.asarray(found["cam_K"], dtype=float).ravel()
            if len(matrix) != 9:
                raise ValueError(f"cam_K has {len(matrix)} numbers instead of 9")
            return _intrinsics(matrix.reshape(3, 3), "cam_K", scale, size)
        fx, fy, cx, cy = (float(found[name]) for name in ("fx", "fy", "cx", "cy"))
        return DepthCamera(fx, fy, cx, cy, scale, size)
    except KeyError as error:
        raise InputError(f"{path} cannot be used: it has no {error}, give fx, fy, cx and cy, or cam_K") from None
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} cannot be used as a camera, which is JSON with fx, fy, cx and cy, or cam_K: {shown(error)}"
        ) from None


def _intrinsics(matrix: np.ndarray, name: str, scale: float, size: tuple[int, int] | None) -> DepthCamera:
    if matrix.shape != (3, 3):
        raise InputError(f"{name} has shape {matrix.shape}, but must be (3, 3)")
    (fx, skew, cx), (zero, fy, cy), last = matrix.astype(float).tolist()
    if (skew, zero, *last) != (0, 0, 0, 0, 1):
        raise InputError(f"{name} must be fx 0 cx 0 fy cy 0 0 1, row by row: a camera with skew is not supported")
    return DepthCamera(fx, fy, cx, cy, scale, size)


def _arrays(content: bytes, suffix: str, has_camera: bool) -> dict[str, np.ndarray]:
    """Return what a file holds by name: points, perhaps with normals, or depth, perhaps with K.

    Rows of NPY files are those of a depth image if a camera is named for it, or if they are long.
    """
    if suffix in CLOUD_SUFFIXES:
        points, normals, _ = parse_mesh(content, suffix)
        return {"points": points} if normals is None else {"points": points, "normals": normals}
    if suffix == ".npz":
        return _npz(content)
    if suffix == ".npy":
        array = _npy(content)
        if not array.size:
            raise InputError(f"it holds nothing: its shape is {array.shape}")
        is_image = array.ndim == 2 and array.shape[1] not in (3, 6) and (has_camera or array.shape[1] >= _NARROWEST)
        return {"depth" if is_image else "points": array}
    if suffix == ".exr":
        return {"depth": parse_exr(content, min(most_elements(), _DENSEST * len(content) // 2))}
    return {"depth": _image(content)}


def _image(content: bytes) -> np.ndarray:
    header = image_header(content, _IMAGE_FORMATS)
    _check_size(header.width * header.height, 2, content)
    _, values = read_image(content, _IMAGE_FORMATS)
    if values.ndim != 2 or values.dtype == np.uint8 or values.dtype == bool:
        kind = f"{values.dtype} with {values.shape[2] if values.ndim == 3 else 1} channels"
        raise InputError(f"it holds {kind}, but depth has one channel of 16 bits or more")
    return values


def _check_size(count: int, itemsize: int, content: bytes) -> None:
    """Refuse what announces more pixels or points than can be true, before memory is taken for them."""
    check_elements(count, "pixels or points")
    if count * itemsize > _DENSEST * len(content):
        raise InputError(f"it is damaged: it announces {count} pixels or points, but has {len(content)} bytes")


def _npy(content: bytes) -> np.ndarray:
    """Return the array of an NPY file's content. No memory is taken for what its header only announces."""
    file = io.BytesIO(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files by Python 2
            version = np.lib.format.read_magic(file)  # later ones hold no plain numbers
            headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, by_columns, dtype = headers[version](file)
            if not all(type(size) is int for size in shape):
                raise ValueError(f"shape {shape}")
    except Exception as error:  # of many kinds: the header is Python text
        raise InputError(f"it is not a readable .npy file ({type(error).__name__}: {shown(error, 80)})") from None
    if dtype.kind not in "fiu":
        raise InputError(f"it does not hold numbers, but {dtype.name} values")
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * dtype.itemsize > len(content) - file.tell():
        raise InputError(f"it is not a readable .npy file: it is truncated, or not of shape {shape}"[:200])
    array = np.frombuffer(content, dtype, count, file.tell()) if count else np.zeros(0, dtype)
    try:
        return array.reshape(shape, order="F" if by_columns else "C")
    except ValueError:  # of nothing, in a shape beyond NumPy's bounds
        raise InputError(f"it is not a readable .npy file: it is damaged, its shape is {shape}"[:200]) from None


def _npz(content: bytes) -> dict[str, np.ndarray]:
    arrays, names, taken = {}, [], 0
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                names.append(name)
                if name in ("points", "normals", "depth", "K"):
                    _check_size(entry.file_size // (6 * 8), 6 * 8, content)
                    taken += entry.file_size
                    check_bytes(taken)
                    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                        raise InputError(f"its {name} are compressed in a way that NumPy does not write")
                    with archive.open(entry) as file:
                        arrays[name] = _npy(file.read(entry.file_size))  # no more, whatever there is
    except InputError:
        raise
    except Exception as error:  # of the archive, and of what unpacks it
        raise InputError(f"it is not a readable .npz file ({type(error).__name__}: {shown(error, 80)})") from None
    if not arrays.keys() & {"points", "depth"}:
        raise InputError(f"it holds {', '.join(names)[:80] or 'nothing'}, but neither points nor depth")
    return arrays


def _cloud(points: np.ndarray, normals: np.ndarray | None, unit: str) -> Scan:
    if points.ndim not in (2, 3) or points.shape[-1] not in (3, 6):
        raise InputError(f"its points have shape {points.shape}, but must be (n, 3), (n, 6), (h, w, 3) or (h, w, 6)")
    if points.shape[-1] == 6 and normals is None:
        points, normals = points[..., :3], points[..., 3:]
    rows = points[..., :3].reshape(-1, 3)
    check_elements(len(rows))
    if normals is not None and (normals.shape[-1:] != (3,) or normals.reshape(-1, 3).shape != rows.shape):
        raise InputError(f"its normals have shape {normals.shape}, but its points {points.shape}")
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        single = rows.astype(np.float32)
        real = (np.abs(single) < _FARTHEST).all(axis=1) & (single != 0).any(axis=1)
    if not real.any():
        raise InputError(f"none of its {len(rows)} points was measured: all are NaN, infinite, far beyond or zero")
    return Scan(held(rows[real]), None if normals is None else _unit(normals.reshape(-1, 3)[real]), None, None, unit)


def _unit(normals: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"] | None:
    """Return normals of length one; none if some are missing."""
    with np.errstate(over="ignore", invalid="ignore"):
        normals = normals.astype(np.float32)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        return None
    return (normals / length).astype(np.float32)


def depth_scan(values: np.ndarray, camera: DepthCamera, unit: str) -> Scan:
    """Return the scan of a depth image (h, w) as it was stored; `depth_scale` turns its values into `unit`.

    Raises InputError if nothing in it was measured, or if the camera is that of another size.
    """
    if values.ndim != 2:
        raise InputError(f"its depth has shape {values.shape}, but must be (h, w)")
    height, width = values.shape
    if camera.size is not None and camera.size != (width, height):
        raise InputError(f"it has {width} x {height} pixels, but its camera {camera.size[0]} x {camera.size[1]}")
    check_elements(values.size, "pixels")
    measured = _measured(values)
    if not measured.any():
        raise InputError(f"none of its {height} x {width} pixels was measured: all are zero, NaN or saturated")
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        depth = (np.where(measured, values, 0).astype(np.float64) * camera.depth_scale).astype(np.float32)
        sensor = Camera(camera.fx, camera.fy, camera.cx, camera.cy, width, height)
        points = measured_points(depth, sensor)
    if not len(points) or not (np.abs(points) < _FARTHEST).all():
        raise InputError(f"its depths in {unit}, or their points, are tiny or huge: check depth_scale, fx, fy and unit")
    return Scan(points, None, depth, sensor, unit)


def _measured(values: np.ndarray) -> Bool[np.ndarray, "h w"]:
    if values.dtype.kind in "iu":
        return (values > 0) & (values != _SATURATED) & (values != np.iinfo(values.dtype).max)
    most = np.finfo(np.float16).max if values.dtype == np.float16 else _FARTHEST  # half floats stop at 65504
    return np.isfinite(values) & (values > 0) & (values < most)
