"""Scans of messages: sensor_msgs' Image with CameraInfo, and PointCloud2.

Messages are read by their attributes only, so that those of rclpy and of other libraries are the same here. Lengths are
metres, as in all of ROS.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kmn_jax import InputError
from kmn_jax.io import Scan, depth_array_scan

# By encoding: what is stored, and how many metres one step is (REP 118).
_DEPTH = {"16UC1": ("u2", 0.001), "mono16": ("u2", 0.001), "32FC1": ("f4", 1.0)}
_FIELDS = {7: "f4", 8: "f8"}  # PointField's FLOAT32 and FLOAT64


def depth_of(image: Any) -> np.ndarray:
    """Return the stored values (h, w) of a depth image. Raises InputError if it is none."""
    if image.encoding not in _DEPTH:
        raise InputError(
            f"the image's encoding is {image.encoding!r}, but must be one of {', '.join(_DEPTH)}: subscribe to a topic"
            " of depth images, not of colours or compressed"
        )
    kind = np.dtype(_DEPTH[image.encoding][0]).newbyteorder(">" if image.is_bigendian else "<")
    content, row = np.frombuffer(bytes(image.data), dtype=np.uint8), image.width * kind.itemsize
    if image.height < 1 or image.width < 1 or image.step < row or len(content) != image.height * image.step:
        raise InputError(
            f"the image of {image.width} x {image.height} pixels has {len(content)} bytes in rows of {image.step},"
            " which do not belong together"
        )
    values = np.ascontiguousarray(content.reshape(image.height, image.step)[:, :row]).view(kind)
    return values.astype(kind.newbyteorder("="))


def intrinsics_of(info: Any, height: int, width: int) -> np.ndarray:
    """Return the matrix (3, 3) of a rectified image of that size. Raises InputError if the camera is of another one.

    It is that of the projection `p`, or `k` where `p` is not filled in, with binning and the region of interest.
    """
    p, k = (np.asarray(values, dtype=np.float64) for values in (info.p, info.k))
    matrix = (p.reshape(3, 4)[:, :3] if p[0] > 0 else k.reshape(3, 3)).copy()
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise InputError("the camera info holds no intrinsics: calibrate the camera, or let its driver publish them")
    across, down = max(1, info.binning_x), max(1, info.binning_y)
    whole = (info.roi.width or info.width) // across, (info.roi.height or info.height) // down
    if (width, height) != whole:
        raise InputError(
            f"the image has {width} x {height} pixels, but its camera info is of {whole[0]} x {whole[1]}: take that of"
            " the same stream"
        )
    matrix[0, 2] -= info.roi.x_offset
    matrix[1, 2] -= info.roi.y_offset
    matrix[0] /= across
    matrix[1] /= down
    return matrix


def scan_of_image(image: Any, info: Any, step: float | None = None) -> Scan:
    """Return a depth image as a scan in the camera's optical frame.

    `step` is how many metres one step of the stored values is, unless it is as REP 118 has it: millimetres of whole
    numbers, metres of fractions. Raises InputError if image and camera cannot be used.
    """
    depth = depth_of(image)
    matrix = intrinsics_of(info, *depth.shape)
    return depth_array_scan(depth, matrix, _DEPTH[image.encoding][1] if step is None else step)


def scan_of_cloud(cloud: Any) -> Scan:
    """Return a cloud, organised or not, as a scan; points that are zero or no numbers were not measured.

    Raises InputError if it has no x, y and z, or none of its points was measured.
    """
    fields = {field.name: field for field in cloud.fields if field.name in ("x", "y", "z")}
    if len(fields) != 3 or any(field.datatype not in _FIELDS for field in fields.values()):
        raise InputError("the cloud has no x, y and z of 32 or 64 bits: subscribe to a topic of points")
    names = list(fields)
    kinds = [
        np.dtype(_FIELDS[fields[name].datatype]).newbyteorder(">" if cloud.is_bigendian else "<") for name in names
    ]
    offsets = [fields[name].offset for name in names]
    content, row = np.frombuffer(bytes(cloud.data), dtype=np.uint8), cloud.width * cloud.point_step
    ends = (offset + kind.itemsize for offset, kind in zip(offsets, kinds, strict=True))
    whole = max(ends) <= cloud.point_step and row <= cloud.row_step and len(content) == cloud.height * cloud.row_step
    if not (whole and row > 0 and cloud.height > 0):
        raise InputError(
            f"the cloud of {cloud.width} x {cloud.height} points has {len(content)} bytes, in points of"
            f" {cloud.point_step} and rows of {cloud.row_step}, which do not belong together"
        )
    layout = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step})
    rows = np.ascontiguousarray(content.reshape(cloud.height, cloud.row_step)[:, :row]).view(layout).reshape(-1)
    points = np.stack([rows[name] for name in ("x", "y", "z")], axis=1).astype(np.float32)
    points = points[np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)]
    if len(points) == 0:
        raise InputError("none of the cloud's points was measured: all are zero, infinite or no numbers")
    return Scan(points, None, None, None, "m")
