"""The mesh of a part, to be shown: object cards hold points only, so it comes from the CAD file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from kmn_jax.errors import InputError
from kmn_jax.io import MESH_SUFFIXES, read_mesh
from kmn_jax.objects import CARD_SUFFIX, Part

_MOST_TRIANGLES = 20_000  # of a copy: more make pages slow


class PartMesh(NamedTuple):
    """Triangles in the part's frame and unit."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]


def part_mesh(source: str | Path, part: Part) -> PartMesh | None:
    """Return the mesh of the file that a part was made of, with fewer triangles if it has very many.

    Of a card, that is the CAD file of the same name beside it, if it is still the one that the card was made of. None
    if there is no mesh.
    """
    source = Path(source)
    files = [source]
    if source.suffix.lower() == CARD_SUFFIX:
        files = [path for path in sorted(source.parent.glob(f"{source.stem}.*")) if path.stem == source.stem]
    for path in files:
        if path.suffix.lower() not in MESH_SUFFIXES:
            continue
        try:
            if hashlib.sha256(path.read_bytes()).hexdigest() != part.source_digest:
                continue
            mesh = read_mesh(path)
        except (InputError, OSError):
            continue
        if len(mesh.triangles):
            return _thinned(_scaled(mesh.vertices, mesh.triangles, part))
    return None


def _scaled(vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], part: Part) -> PartMesh:
    """Return a mesh in the part's unit, whatever its own is: both boxes are of one size."""
    used = vertices[triangles.reshape(-1)]
    factor = np.linalg.norm(part.maximum - part.minimum) / np.linalg.norm(np.ptp(used, axis=0))
    return PartMesh(vertices * factor, triangles)


def _thinned(mesh: PartMesh) -> PartMesh:
    if len(mesh.triangles) <= _MOST_TRIANGLES:
        return mesh
    import open3d

    # Triangles of STL files share no vertices.
    vertices, rows = np.unique(mesh.vertices, axis=0, return_inverse=True)
    whole = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(rows[mesh.triangles])
    )
    fewer = whole.simplify_quadric_decimation(_MOST_TRIANGLES)
    return PartMesh(np.asarray(fewer.vertices), np.asarray(fewer.triangles))
