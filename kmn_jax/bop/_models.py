"""The models folder of a BOP dataset: meshes in millimetres, sizes and symmetries, written and read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int

from kmn_jax.bop._files import BopFault, Entry, checked_file, files_by_id, json_by_id, millimetres, read_json_by_id
from kmn_jax.errors import InputError
from kmn_jax.files import make_folder, write_whole
from kmn_jax.objects import ObjectModel

NAMES_FILE = "object_names.json"  # ours: BOP objects have numbers only
_INFO_FILE = "models_info.json"


@dataclass(frozen=True, eq=False)
class BopModel:
    """What a dataset tells of an object; the mesh itself is read from `path`, in millimetres."""

    diameter: float
    size: Float[np.ndarray, "3"]  # of the axis-aligned box around it
    path: Path | None
    name: str | None


def write_models(folder: str | Path, models: Mapping[int, ObjectModel]) -> None:
    """Write objects by id as PLY meshes with vertex normals, their sizes and symmetries, and their names.

    Vertices are stored in float32 millimetres. An object without triangles is written as a cloud. Raises InputError
    for an id below 1, for an object too far from its frame's origin, and if the folder cannot be written to.
    """
    for object_id, model in models.items():
        model.near()
        if object_id < 1:
            raise InputError(f"models: object id {object_id} must be 1 or more")
    target = Path(folder) / "models"
    make_folder(target)
    for object_id, model in models.items():
        factor = millimetres(model.unit)
        vertices, normals = model.vertices, vertex_normals(model.vertices, model.triangles)
        if len(model.triangles) == 0:
            vertices, normals = model.points, model.normals
        write_whole(target / f"obj_{object_id:06d}.ply", ply_bytes(vertices * factor, normals, model.triangles))
    write_whole(target / _INFO_FILE, json_by_id({key: _format_info(model) for key, model in models.items()}))
    write_whole(target / NAMES_FILE, json_by_id({key: model.name for key, model in models.items()}))


def read_models(folder: Path, unit: str) -> tuple[dict[int, BopModel], dict[int | None, BopFault]]:
    """Return the usable models of a folder in `unit`, and what is wrong with the others, or (None) with all of them."""
    factor, info = 1 / millimetres(unit), folder / _INFO_FILE
    meshes, faults, models = mesh_files(folder), dict[int | None, BopFault](), dict[int, BopModel]()
    try:
        infos = read_json_by_id(info)
        names = read_json_by_id(folder / NAMES_FILE) if (folder / NAMES_FILE).exists() else {}
    except BopFault as fault:
        return {}, {None: fault}
    for object_id in sorted({*meshes, *infos}):
        path, name = meshes.get(object_id), names.get(object_id)
        try:
            if object_id not in infos:
                raise BopFault(info, f"object {object_id}", f"is missing, but {meshes[object_id].name} exists")
            if path is not None:
                checked_file(path)
            entry = Entry(info, f"object {object_id}", infos[object_id])
            size, diameter = np.array([entry.number(f"size_{axis}") for axis in "xyz"]), entry.number("diameter")
            if diameter <= 0 or size.min() < 0:
                raise entry.fault(f"diameter is {diameter:g} and must be above zero, as must be the sizes")
            models[object_id] = BopModel(diameter * factor, size * factor, path, None if name is None else str(name))
        except BopFault as fault:
            faults[object_id] = fault
    return models, faults


def mesh_files(folder: Path) -> dict[int, Path]:
    """Return the meshes of a models folder by the ids of their objects."""
    return files_by_id(folder, (".ply",), prefix="obj_")


def vertex_normals(vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "v 3"]:
    """Return the unit means of the normals of the triangles around each vertex, weighted by their angles there."""
    corners = vertices[triangles].astype(np.float64)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), np.finfo(float).tiny)
    normals = np.zeros((len(vertices), 3))
    for corner in range(3):
        first, second = (corners[:, (corner + step) % 3] - corners[:, corner] for step in (1, 2))
        lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
        cosine = (first * second).sum(axis=1) / np.maximum(lengths, np.finfo(float).tiny)
        np.add.at(normals, triangles[:, corner], np.arccos(np.clip(cosine, -1, 1))[:, None] * face)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)


def ply_bytes(
    vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> bytes:
    """Return a binary PLY file of a mesh with vertex normals; without triangles, of a cloud."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    if len(triangles):
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
    rows: Float32[np.ndarray, "v 6"] = np.concatenate([vertices, normals], axis=1).astype("<f4")
    faces = np.zeros(len(triangles), dtype=[("count", "u1"), ("indices", "<i4", (3,))])
    faces["count"], faces["indices"] = 3, triangles
    return "\n".join([*header, "end_header", ""]).encode() + rows.tobytes() + faces.tobytes()


def _format_info(model: ObjectModel) -> dict[str, object]:
    factor = millimetres(model.unit)
    info: dict[str, object] = {"diameter": float(model.diameter * factor)}
    for axis, low, side in zip("xyz", model.minimum, model.extents, strict=True):
        info |= {f"min_{axis}": float(low * factor), f"size_{axis}": float(side * factor)}
    transforms = model.symmetries.transforms.copy()
    transforms[:, :3, 3] *= factor
    if len(transforms) > 1:  # the identity comes first, and goes without saying in BOP
        info["symmetries_discrete"] = [transform.ravel().tolist() for transform in transforms[1:]]
    if len(model.symmetries.axes):
        offset = (model.symmetries.center * factor).tolist()
        info["symmetries_continuous"] = [{"axis": axis.tolist(), "offset": offset} for axis in model.symmetries.axes]
    return info
