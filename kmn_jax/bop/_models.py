"""The models folder of a BOP dataset: meshes in millimetres, sizes and symmetries, written and read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int

from kmn_jax.bop._files import BopFault, Entry, files_by_id, is_rotation, json_by_id, millimetres, read_json_by_id
from kmn_jax.errors import InputError
from kmn_jax.files import write_whole
from kmn_jax.objects import ObjectModel

NAMES_FILE = "object_names.json"  # ours: BOP objects have numbers only
_INFO_FILE = "models_info.json"
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class BopModel:
    """What a dataset tells of an object, in its frame; the mesh itself is read from `path`, in millimetres."""

    object_id: int
    diameter: float
    minimum: Float[np.ndarray, "3"]  # of the axis-aligned box around it
    size: Float[np.ndarray, "3"]
    symmetries: Float[np.ndarray, "s 4 4"]  # discrete ones as T_object_object, the identity first
    axes: Float[np.ndarray, "c 3"]  # directions about which every angle is a symmetry
    offsets: Float[np.ndarray, "c 3"]  # a point on each axis
    path: Path | None
    name: str | None


def write_models(folder: str | Path, models: Mapping[int, ObjectModel], kind: str = "models") -> None:
    """Write objects by id as PLY meshes with vertex normals, their sizes and symmetries, and their names.

    Vertices are stored in float32 millimetres. An object without triangles is written as a cloud. Raises InputError
    for an id below 1, and if the folder cannot be written to.
    """
    for object_id in models:
        if object_id < 1:
            raise InputError(f"models: object id {object_id} must be 1 or more")
    target = Path(folder) / kind
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror}") from None
    for object_id, model in models.items():
        factor = millimetres(model.unit)
        vertices, normals = model.vertices, vertex_normals(model.vertices, model.triangles)
        if len(model.triangles) == 0:
            vertices, normals = model.points, model.normals
        write_whole(target / f"obj_{object_id:06d}.ply", ply_bytes(vertices * factor, normals, model.triangles))
    write_whole(target / _INFO_FILE, json_by_id({key: _format_info(model) for key, model in models.items()}))
    write_whole(target / NAMES_FILE, json_by_id({key: model.name for key, model in models.items()}))


def model_ids(folder: Path) -> tuple[int, ...] | None:
    """Return the ids that a models folder knows by mesh or by size, None if there is neither."""
    ids = set(_meshes(folder))
    if (folder / _INFO_FILE).exists():
        try:
            ids |= set(read_json_by_id(folder / _INFO_FILE))
        except BopFault:
            if not ids:
                return None
    return tuple(sorted(ids)) or None


def read_models(folder: Path, unit: str) -> tuple[dict[int, BopModel], dict[int | None, BopFault]]:
    """Return the usable models of a folder in `unit`, and what is wrong with the others, or (None) with all of them."""
    factor = 1 / millimetres(unit)
    meshes, faults, models = _meshes(folder), dict[int | None, BopFault](), dict[int, BopModel]()
    try:
        infos = read_json_by_id(folder / _INFO_FILE)
        names = read_json_by_id(folder / NAMES_FILE) if (folder / NAMES_FILE).exists() else {}
    except BopFault as fault:
        return {}, {None: fault}
    for object_id, values in infos.items():
        path, name = meshes.get(object_id), names.get(object_id)
        try:
            entry = Entry(folder / _INFO_FILE, f"object {object_id}", values)
            if path is not None and path.stat().st_size == 0:
                raise BopFault(path, "", "is empty (0 bytes): write it again")
            models[object_id] = _parse_info(entry, object_id, factor, path, None if name is None else str(name))
        except BopFault as fault:
            faults[object_id] = fault
    for object_id in sorted(set(meshes) - set(infos)):
        what = f"is missing, but {meshes[object_id].name} exists"
        faults[object_id] = BopFault(folder / _INFO_FILE, f"object {object_id}", what)
    return models, faults


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


def _meshes(folder: Path) -> dict[int, Path]:
    return files_by_id(folder, (".ply",), prefix="obj_")


def _format_info(model: ObjectModel) -> dict[str, object]:
    factor = millimetres(model.unit)
    info: dict[str, object] = {"diameter": float(model.diameter * factor)}
    for axis, low, side in zip(_AXES, model.minimum, model.extents, strict=True):
        info |= {f"min_{axis}": float(low * factor), f"size_{axis}": float(side * factor)}
    transforms = model.symmetries.transforms.copy()
    transforms[:, :3, 3] *= factor
    if len(transforms) > 1:  # the identity comes first, and goes without saying in BOP
        info["symmetries_discrete"] = [transform.ravel().tolist() for transform in transforms[1:]]
    if len(model.symmetries.axes):
        offset = (model.symmetries.center * factor).tolist()
        info["symmetries_continuous"] = [{"axis": axis.tolist(), "offset": offset} for axis in model.symmetries.axes]
    return info


def _parse_info(entry: Entry, object_id: int, factor: float, path: Path | None, name: str | None) -> BopModel:
    minimum, size = (np.array([entry.number(f"{key}_{axis}") for axis in _AXES]) * factor for key in ("min", "size"))
    diameter = entry.number("diameter") * factor
    if diameter <= 0 or size.min() < 0:
        raise entry.fault(f"diameter is {entry.number('diameter'):g} and must be above zero, as must be the sizes")
    symmetries = [np.eye(4)]
    for values in _listed(entry, "symmetries_discrete"):
        transform = Entry(entry.file, entry.name, {"symmetries_discrete": values}).numbers("symmetries_discrete", 16)
        transform = transform.reshape(4, 4)
        if not is_rotation(transform[:3, :3]) or transform[3].tolist() != [0, 0, 0, 1]:
            raise entry.fault("symmetries_discrete holds a matrix that is not rigid")
        transform[:3, 3] *= factor
        symmetries.append(transform)
    axes, offsets = [], []
    for values in _listed(entry, "symmetries_continuous"):
        continuous = Entry(entry.file, f"{entry.name}, symmetries_continuous", values)
        axes.append(continuous.numbers("axis", 3))
        offsets.append(continuous.numbers("offset", 3) * factor)
        if not axes[-1].any():
            raise continuous.fault("axis is zero, which is no direction")
    rows = (np.array(axes).reshape(-1, 3), np.array(offsets).reshape(-1, 3))
    return BopModel(object_id, diameter, minimum, size, np.stack(symmetries), *rows, path, name)


def _listed(entry: Entry, key: str) -> list[object]:
    values = entry.values.get(key, [])
    if not isinstance(values, list):
        raise entry.fault(f"{key} must be a list")
    return values
