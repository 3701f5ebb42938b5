"""What parts and scans can be given as, beside files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np

from kmn_jax.errors import InputError
from kmn_jax.io import CameraMatrix, Scan, UnitWords, depth_array_scan, stated_unit
from kmn_jax.objects import (
    Grasps,
    ObjectConfig,
    ObjectModel,
    load_grasps,
    load_object,
    object_from_cloud,
    object_from_mesh,
)
from kmn_jax.typing import ArrayInput
from kmn_jax.units import check_unit


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
    if isinstance(scan, Scan) and (camera is not None or unit not in (None, "auto", scan.unit)):
        raise InputError(f"a Scan has its own camera and unit, here {scan.unit}: leave camera and unit out")
    if hasattr(scan, "__array__"):
        scan = np.asarray(scan)  # of JAX, perhaps
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


def unit_words(scan: ScanSource, K: CameraMatrix | None, unit: str | None) -> UnitWords:
    """Return what says the units of part and scan in such a call: the command's, and only it, has a unit of files."""
    if isinstance(scan, str | Path) and unit is not None:
        return UnitWords()
    by = "unit" if K is None else "depth_unit"
    return UnitWords(f'{by}="{{}}"' + (" of the Scan" if isinstance(scan, Scan) else ""), 'unit="{}" to prepare')


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


def is_unit_assumed(source: PartSource, unit: str | None) -> bool:
    """Tell whether neither `unit` nor a part's file says what its numbers are in: they are taken for millimetres."""
    return unit is None and not (isinstance(source, str | Path) and stated_unit(source))


def object_of(source: PartSource, unit: str | None, name: str | None, config: ObjectConfig) -> ObjectModel:
    """Make an object model of what a part can be given as, see `PoseEstimator.prepare`."""
    if isinstance(source, str | Path):
        stated = stated_unit(source)
        if stated is None:
            return load_object(source, unit, config)
        return load_object(source, None, config).in_unit(unit or stated)
    unit, name = check_unit(unit or "mm"), name or "part"
    if not isinstance(source, np.ndarray):
        if not isinstance(source, tuple) and hasattr(source, "vertices") and hasattr(source, "faces"):
            source = (source.vertices, source.faces)
        if not isinstance(source, tuple) or len(source) != 2:
            raise InputError(f"an object cannot be made of a {type(source).__name__}: give a file, a cloud or a mesh")
        vertices, triangles = (np.asarray(array) for array in source)
        return object_from_mesh(name, vertices.astype(np.float64), triangles.astype(np.int64), unit, config)
    cloud = np.asarray(source)
    if cloud.ndim != 2 or cloud.shape[1] not in (3, 6):
        raise InputError(f"the object's cloud has shape {cloud.shape}, but must be (n, 3), or (n, 6) with normals")
    normals = cloud[:, 3:].astype(np.float64) if cloud.shape[1] == 6 else None
    return object_from_cloud(name, cloud[:, :3].astype(np.float64), normals, unit, config)
