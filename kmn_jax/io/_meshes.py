"""Reading CAD meshes and object clouds from files, with their unit, and refusing what is broken."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int, Int32, Int64

from kmn_jax.errors import InputError
from kmn_jax.io._clouds import parse_pcd, parse_xyz
from kmn_jax.io._glb import parse_glb
from kmn_jax.io._ply import parse_ply
from kmn_jax.io._step import step_to_glb
from kmn_jax.io._stl_obj import parse_obj, parse_stl
from kmn_jax.limits import check_bytes, most_bytes
from kmn_jax.units import check_unit

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb", ".step", ".stp")
CLOUD_SUFFIXES = (".ply", ".pcd", ".xyz", ".xyzn")
_FARTHEST = 1e18  # the squares of longer lengths leave float32
_IN_METRES = (".glb", ".step", ".stp")  # STEP files state their unit; cascadio converts it

Parsed = tuple[Float64[np.ndarray, "v 3"], Float64[np.ndarray, "v 3"] | None, Int64[np.ndarray, "t 3"]]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles as a file holds them, or a cloud if there are none. Frame and winding are the file's own."""

    vertices: Float64[np.ndarray, "v 3"]
    triangles: Int32[np.ndarray, "t 3"]
    normals: Float64[np.ndarray, "v 3"] | None  # of a cloud whose file has them, all of them finite
    unit: str


def read_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """Read a mesh (STL, OBJ, PLY, GLB, STEP) or a point cloud (PLY without faces, PCD, XYZ).

    GLB and STEP files state their unit and come in metres. The others have none: `unit` says what theirs is,
    millimetres unless given, as nearly all CAD files are. A unit given for GLB or STEP must be metres.
    Raises InputError if the file is missing, of another format, empty, truncated, or holds NaN or bad indices.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES + CLOUD_SUFFIXES:
        known = ", ".join(dict.fromkeys(MESH_SUFFIXES + CLOUD_SUFFIXES))
        raise InputError(f"{path}: the format {suffix or 'without a suffix'} is not known: use one of {known}")
    if suffix in _IN_METRES and unit not in (None, "m"):
        raise InputError(f"{path}: {suffix} files are read in metres, so the unit cannot be {unit}: leave it out")
    unit = check_unit(("m" if suffix in _IN_METRES else "mm") if unit is None else unit)
    content = read_file(path)
    try:
        vertices, normals, triangles = parse_mesh(content, suffix)
        if len(triangles) == 0 and suffix not in CLOUD_SUFFIXES:
            raise InputError(f"it holds no triangles: it is empty, truncated or not a {suffix} file")
        check_triangles(vertices, triangles)
    except InputError as error:
        raise InputError(f"{path} cannot be used: {error}") from None
    except MemoryError:
        raise InputError(f"{path} cannot be used: it does not fit into memory") from None
    if len(triangles) or (normals is not None and not np.isfinite(normals).all()):
        normals = None
    return Mesh(vertices, triangles.astype(np.int32), normals, unit)


def read_file(path: Path, what: str = "a CAD file") -> bytes:
    """Return the content of a file, or raise InputError if it is missing, not a file, empty, or beyond the budget."""
    try:
        regular = path.is_file() or not path.exists()
        size = path.stat().st_size
        content = path.read_bytes() if regular and size <= most_bytes() else b""
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError as error:  # a null character
        raise InputError(f"{str(path)!r} cannot be read: {error}") from None
    if not regular:
        raise InputError(f"{path} is {'a folder' if path.is_dir() else 'not a regular file'}: name {what}")
    try:
        check_bytes(size)
    except InputError as error:
        raise InputError(f"{path} cannot be used: {error}") from None
    if not content:
        raise InputError(f"{path} is empty (0 bytes): name {what}")
    return content


def parse_mesh(content: bytes, suffix: str) -> Parsed:
    """Return vertices, the normals of a cloud if it has any, and triangles of a file's content, as they are.

    Raises InputError, without the file's name, if it is not of that format or truncated.
    """
    none = np.zeros((0, 3), np.int64)
    match suffix:
        case ".stl":
            vertices = parse_stl(content).reshape(-1, 3)
            return vertices, None, np.arange(len(vertices)).reshape(-1, 3)
        case ".obj":
            vertices, triangles = parse_obj(content)
            return vertices, None, triangles
        case ".ply":
            return parse_ply(content)
        case ".pcd":
            return *parse_pcd(content), none
        case ".xyz" | ".xyzn":
            return *parse_xyz(content, with_normals=suffix == ".xyzn"), none
    vertices, triangles = parse_glb(content if suffix == ".glb" else step_to_glb(content))
    return vertices, None, triangles


def check_triangles(vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
    """Raise InputError for no vertices, NaN, infinite or huge ones, and for triangles that name others."""
    if len(vertices) == 0:
        raise InputError("there are no points")
    bad = ~(np.abs(vertices) <= _FARTHEST).all(axis=1)
    if bad.any():
        raise InputError(
            f"{bad.sum()} of {len(bad)} vertices are NaN, infinite or beyond {_FARTHEST:g}, the first is number"
            f" {int(bad.argmax())}: export the object again"
        )
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError(
            f"triangles name vertices from {triangles.min()} to {triangles.max()}, but there are 0 to"
            f" {len(vertices) - 1}: export the object again"
        )
