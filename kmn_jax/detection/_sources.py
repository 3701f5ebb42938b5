"""What parts and scans can be given as, beside files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

from kmn_jax.errors import InputError
from kmn_jax.io import CameraMatrix, Scan, depth_array_scan
from kmn_jax.objects import Grasps, load_grasps
from kmn_jax.typing import ArrayInput


class MeshLike(Protocol):
    """A mesh of another library, such as trimesh."""

    @property
    def vertices(self) -> Any:
        """Points (v, 3)."""

    @property
    def faces(self) -> Any:
        """Rows of vertices (t, 3)."""


# What a part is made of, see PoseEstimator.prepare, which judges it with its own errors.
if TYPE_CHECKING:
    PartSource: TypeAlias = str | Path | np.ndarray | tuple[ArrayInput, ArrayInput] | MeshLike
else:
    PartSource = Any
ScanSource: TypeAlias = str | Path | np.ndarray | Scan
GraspSource: TypeAlias = str | Path | Grasps


def arranged(
    scan: ScanSource, K: CameraMatrix | None, depth_unit: str | float | None, camera: object, unit: str | None
) -> ScanSource:
    """Return arrays as scans or points (n, 3). Raises InputError for arguments that contradict each other."""
    if K is None and depth_unit is None:
        if isinstance(scan, np.ndarray) and scan.ndim == 3 and scan.shape[2] == 3:
            return scan.reshape(-1, 3)
        if isinstance(scan, np.ndarray) and scan.ndim == 2 and scan.shape[1] != 3:
            raise InputError(
                f"the scan has shape {scan.shape}: give K with a depth image (h, w), or points (n, 3) or (h, w, 3)"
            )
        return scan
    if not isinstance(scan, np.ndarray):
        raise InputError("K and depth_unit are for depth images as arrays: give a file with camera and unit")
    if K is None:
        raise InputError("depth_unit is for depth images, which need K: the intrinsics (3, 3), or fx, fy, cx, cy")
    if camera is not None or unit is not None:
        raise InputError("K and depth_unit say all that camera and unit would: leave these out")
    return depth_array_scan(scan, K, depth_unit)


def grasps_of(given: GraspSource | Sequence[GraspSource | None] | None, count: int) -> list[Grasps | None]:
    """Return the grasps of each of several parts. Raises InputError if they are not as many as the parts."""
    if given is None:
        return [None] * count
    each = [given] if isinstance(given, str | Path | Grasps) else list(given)
    if len(each) != count:
        raise InputError(
            f"grasps are given for {len(each)} parts, but there are {count}: give a file, or none, for each"
        )
    return [load_grasps(one) if isinstance(one, str | Path) else one for one in each]
