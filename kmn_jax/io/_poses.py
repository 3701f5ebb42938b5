"""Poses in files, such as that of a camera in a robot's frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from kmn_jax.errors import InputError, finite_numbers, known_fields, rigid_pose, shown
from kmn_jax.io._meshes import read_file
from kmn_jax.limits import parse_json
from kmn_jax.typing import ArrayInput
from kmn_jax.units import METRES, Unit, check_unit


def read_pose(path: str | Path, name: str) -> tuple[Float64[np.ndarray, "4 4"], Unit | None]:
    """Read a pose from JSON, and the unit of its lengths if the file says so.

    The file holds a 4 x 4 matrix, alone or under `name` (such as `T_base_camera`), or `xyz` and the quaternion `xyzw`;
    and perhaps `unit`. Raises InputError if it is missing, no JSON, or holds no rigid pose.
    """
    path = Path(path)
    content = read_file(path, "a file with a pose")
    try:
        found = parse_json(content.decode("utf-8"))
        if not isinstance(found, dict):
            return pose_matrix(found, name), None
        known_fields(found, "it", {name, "xyz", "xyzw", "unit"})
        return pose_of(found, name), None if found.get("unit") is None else check_unit(str(found["unit"]))
    except ValueError as error:  # InputError is one
        raise InputError(f"{path} cannot be used as a pose: {shown(error)}") from None


def pose_of(values: Mapping[str, Any], name: str) -> Float64[np.ndarray, "4 4"]:
    """Return the pose that JSON values hold as a matrix under `name`, or as `xyz` and `xyzw`; or raise InputError."""
    if name in values:
        if {"xyz", "xyzw"} & values.keys():
            raise InputError(f"it has both {name} and xyz or xyzw: leave one of them out")
        return pose_matrix(values[name], name)
    if not {"xyz", "xyzw"} <= values.keys():
        raise InputError(f"it has no {name} (4 x 4 numbers), and no xyz with xyzw")
    place, quaternion = (finite_numbers(values[key], key, count) for key, count in (("xyz", 3), ("xyzw", 4)))
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(quaternion))
    if not 0.99 < length < 1.01:
        raise InputError(f"xyzw has the length {length:.3g}, but must be a unit quaternion")
    x, y, z, w = quaternion / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = place
    return pose


def pose_matrix(value: ArrayInput, name: str) -> Float64[np.ndarray, "4 4"]:
    """Return a rigid pose in double precision, the nearest one to rounded digits, or raise InputError."""
    try:
        pose = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} is no matrix of 4 x 4 numbers") from None
    rigid_pose(pose, name)
    if not np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), rtol=0, atol=1e-12):
        left, _, right = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = left @ right
    pose[3] = 0, 0, 0, 1
    return pose


def in_other_unit(pose: Float64[np.ndarray, "4 4"], unit: str, other: str) -> Float64[np.ndarray, "4 4"]:
    """Return a pose with its lengths in another unit."""
    result = pose.copy()
    result[:3, 3] *= METRES[check_unit(unit)] / METRES[check_unit(other)]
    return result
