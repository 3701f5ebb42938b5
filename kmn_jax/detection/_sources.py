"""What parts, scans, grasps and places can be given as, and each as what is computed with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from jaxtyping import Float

from kmn_jax.bop import bop_object, bop_scan, bop_scene_id, is_bop_image
from kmn_jax.errors import InputError, float_array, row_count
from kmn_jax.io import (
    CameraMatrix,
    Scan,
    UnitWords,
    depth_array_scan,
    held,
    read_scan,
    resolve_unit,
    stated_unit,
)
from kmn_jax.objects import (
    Grasps,
    ObjectConfig,
    ObjectModel,
    Part,
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
    part = 'unit="{}" to prepare'
    if isinstance(scan, str | Path):
        return UnitWords() if unit is not None else UnitWords('unit="{}"', part)
    if K is not None:
        return UnitWords('depth_unit="{}"', part, "depth_unit in metres for one step")
    return UnitWords('unit="{}"' + (" of the Scan" if isinstance(scan, Scan) else ""), part, None)


def grasps_of(given: GraspSource | Sequence[GraspSource | None] | None, count: int) -> list[Grasps | None]:
    """Return the grasps of each of several parts. Raises InputError if they are not as many as the parts."""
    if given is None:
        return [None] * count
    each: list[Any] = list(given) if isinstance(given, list | tuple) else [given]
    for one in each:
        if not isinstance(one, str | Path | Grasps | None):
            raise InputError(f"grasps are a {type(one).__name__}, but must be a file, or what load_grasps returns")
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
        if triangles.dtype.kind not in "iuf" or (triangles % 1 != 0).any():
            raise InputError("the mesh's triangles must be rows of three whole numbers: which vertices they have")
        return object_from_mesh(name, vertices.astype(np.float64), triangles.astype(np.int64), unit, config)
    cloud = np.asarray(source)
    if cloud.ndim != 2 or cloud.shape[1] not in (3, 6):
        raise InputError(f"the object's cloud has shape {cloud.shape}, but must be (n, 3), or (n, 6) with normals")
    normals = cloud[:, 3:].astype(np.float64) if cloud.shape[1] == 6 else None
    return object_from_cloud(name, cloud[:, :3].astype(np.float64), normals, unit, config)


def places_of(at: ArrayInput | None) -> Float[np.ndarray, "k 3"] | None:
    """Return places to search at, one (3,) or several (k, 3), as rows in double precision."""
    if at is None:
        return None
    row_count(at, "at")
    rows = np.atleast_2d(np.asarray(at))
    float_array(rows, "at", (None, 3))
    return rows.astype(np.float64)


def parts_of(given: Any) -> list[Part]:
    """Return one part or several as a list. Raises InputError for what is none, such as a file's name."""
    parts = list(given) if isinstance(given, Iterable) and not isinstance(given, str) else [given]
    for one in parts:
        if not isinstance(one, Part):
            raise InputError(
                f"a {type(one).__name__} is no Part to search: make one with prepare, of a file or of arrays"
            )
    return parts


def read_source(
    source: ScanSource, unit: str | None, camera: str | Path | None, part: Part
) -> tuple[Scan, tuple[Float[np.ndarray, "4 4"], ...] | None, tuple[int, int, int]]:
    """Return a scan; of an image of a BOP dataset also the true poses of a part, if known, and what it is called.

    `source` is as `arranged` returns it.
    """
    nothing, asked = (0, 0, 1), unit or "auto"
    if isinstance(source, Scan):
        if not len(source.points):
            raise InputError("the scan has no points")
        return source, None, nothing
    if isinstance(source, str | Path):
        path = Path(source)
        if camera is not None or not is_bop_image(path):
            return read_scan(path, resolve_unit(asked, part.unit), camera), None, nothing
        scan, instances = bop_scan(path, resolve_unit(asked, part.unit, "mm"))
        inside = part.in_unit("mm")
        alike = bop_object(path, instances, inside.diameter, inside.maximum - inside.minimum)
        ids = (bop_scene_id(path), int(path.stem), 1 if alike is None else alike)
        if alike is None:
            return scan, None, ids
        copies = [instance for instance in instances or () if instance.object_id == alike]
        return scan, tuple(instance.T_camera_object for instance in copies), ids
    single = np.asarray(float_array(source, "scan", (None, 3), finite=False), dtype=np.float32)
    given = np.asarray(source)
    if given.dtype.itemsize < 2:
        raise InputError(f"the scan holds {given.dtype} values, as an image of colours does: give points, or its depth")
    real = np.isfinite(single).all(axis=1) & (single != 0).any(axis=1)
    if not real.any():
        raise InputError(f"none of the scan's {len(single)} points was measured: all are NaN, infinite or zero")
    points = held(given[real].astype(np.float64))
    return Scan(points, None, None, None, resolve_unit(asked, part.unit)), None, nothing
