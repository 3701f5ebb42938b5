"""Reading CAD meshes and object clouds from files, with their unit, and refusing what is broken."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.checks import InputError

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # one of each unit, in metres
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb", ".step", ".stp")
CLOUD_SUFFIXES = (".ply", ".pcd", ".xyz", ".xyzn")
_OWN_UNIT = {".glb": "m", ".step": "m", ".stp": "m"}  # STEP files state theirs; cascadio converts it to metres


@dataclass(frozen=True)
class Mesh:
    """Triangles as a file holds them, or a cloud if there are none. Frame and winding are the file's own."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    normals: Float[np.ndarray, "v 3"] | None  # of a cloud whose file has them
    unit: str


def check_unit(unit: str) -> str:
    """Return a known unit of length, or raise InputError."""
    if unit not in METRES:
        raise InputError(f"unit {unit!r} is not known: use one of {', '.join(METRES)}")
    return unit


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
    own = _OWN_UNIT.get(suffix)
    if own and unit not in (None, own):
        raise InputError(f"{path}: {suffix} files are read in metres, so the unit cannot be {unit}: leave it out")
    unit = check_unit(unit or own or "mm")
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if path.is_dir() or size == 0:
        raise InputError(f"{path} is {'a folder' if path.is_dir() else 'empty (0 bytes)'}: name a CAD file")
    vertices, triangles = (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    if suffix in MESH_SUFFIXES:
        vertices, triangles = _read_triangles(path, suffix)
    normals = None
    if len(triangles) == 0 and suffix in CLOUD_SUFFIXES:
        vertices, normals = _read_cloud(path)
    if len(vertices) == 0 or (len(triangles) == 0 and suffix not in CLOUD_SUFFIXES):
        raise InputError(f"{path} holds no triangles: it is empty, truncated or not a {suffix} file")
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum()} of {len(bad)} vertices are NaN or infinite, the first is number"
            f" {int(bad.argmax())}: export the part again"
        )
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError(f"{path}: triangles name vertices outside of 0..{len(vertices) - 1}: export the part again")
    return Mesh(vertices, triangles.astype(np.int32), normals, unit)


def _read_triangles(path: Path, suffix: str) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    if suffix == ".stl":
        _check_stl_length(path)
    try:
        with _silence() if suffix in (".step", ".stp") else contextlib.nullcontext():
            loaded = trimesh.load_scene(path, process=False)
    except ImportError as error:
        raise InputError(
            f"{path} needs a reader that is not installed ({error}): pip install 'kmn_jax[data]'"
        ) from None
    except Exception as error:  # every loader has errors of its own, none of them about the file as a whole
        raise InputError(f"{path} cannot be read as {suffix}: it is truncated or damaged ({_brief(error)})") from None
    parts = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    triangles = [np.asarray(part.faces, dtype=np.int64) + start for part, start in zip(parts, starts, strict=True)]
    return np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts]), np.concatenate(triangles)


def _check_stl_length(path: Path) -> None:
    """Refuse truncated STL files, which readers take for shorter or empty ones."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
        file.seek(max(0, size - 400))
        tail = file.read().rstrip(b"\0 \t\r\n").lower()
    declared = int.from_bytes(head[80:84], "little") if len(head) == 84 else -1
    if declared >= 0 and size == 84 + 50 * declared:
        return
    if head.lstrip().lower().startswith(b"solid"):
        if b"endsolid" not in tail:
            raise InputError(f"{path} is truncated: it has no 'endsolid' at its end")
    elif declared < 0 or size < 84 + 50 * declared:
        raise InputError(
            f"{path} is truncated or not an STL file: it has {size} bytes"
            + (f", but announces {declared} triangles, which take {84 + 50 * declared}" if declared >= 0 else "")
        )


def _read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error), _silence():
        cloud = open3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    return np.asarray(cloud.points).copy(), np.asarray(cloud.normals).copy() if cloud.has_normals() else None


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep what compiled readers print from the user: their failures are reported as errors."""
    with tempfile.TemporaryFile() as sink:
        saved = [(number, os.dup(number)) for number in (1, 2)]
        try:
            for number, _ in saved:
                os.dup2(sink.fileno(), number)
            yield
        finally:
            for number, copy in saved:
                os.dup2(copy, number)
                os.close(copy)


def _brief(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:120]}" if lines else type(error).__name__
