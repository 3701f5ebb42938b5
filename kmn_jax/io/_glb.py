"""Parsing GLB files: their tree is weighed before it unfolds."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from kmn_jax.errors import InputError
from kmn_jax.io._silence import silence
from kmn_jax.limits import check_bytes, check_elements, parse_json

_MOST_PIECES = 20_000  # nodes and their meshes: the reader takes 0.2 ms for each
_DEEPEST = 100  # levels of nodes
_CUBE = 2000  # the reader's time for a node grows with the cube of its level: at level 13 it is twice that at the top
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}


def parse_glb(content: bytes) -> tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "t 3"]]:
    """Return the vertices and triangles of a GLB file's content, with all transforms applied, in metres.

    Raises InputError, without the file's name, if the content is truncated, damaged, or unfolds beyond the budget.
    """
    if content[:4] != b"glTF" or int.from_bytes(content[8:12], "little") != len(content):
        raise InputError("it is truncated, or not a GLB file")
    _check_counts(content)
    import trimesh

    try:
        with silence("trimesh"):
            scene = trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False, skip_materials=True)
            mesh = scene.to_mesh()
            vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # the reader has no error of its own, but all that Python has
        reason = str(error).strip().partition("\n")[0][:120]
        raise InputError(f"it is damaged ({type(error).__name__}: {reason})") from None
    if vertices.shape[1:] != (3,) or triangles.shape[1:] != (3,):
        raise InputError("it is damaged: its positions or triangles are not three numbers each")
    return vertices, triangles


def _check_counts(content: bytes) -> None:
    """Refuse what announces more values than it has bytes, which the reader would make up, and what unfolds too far."""
    try:
        tree = parse_json(content[20 : 20 + int.from_bytes(content[12:16], "little")])
        accessors, nodes, meshes = (list(tree.get(name, ())) for name in ("accessors", "nodes", "meshes"))
        counts = [int(accessor["count"]) for accessor in accessors]
        taken = sum(int(view["byteLength"]) for view in tree.get("bufferViews", ()))
        taken += sum(count * _itemsize(accessor) for count, accessor in zip(counts, accessors, strict=True))
        parts = [[_elements(primitive, counts) for primitive in mesh["primitives"]] for mesh in meshes]
        visits, deep = _visits(tree, nodes)
        shown = [parts[node["mesh"]] if "mesh" in node else [] for node in nodes]
        pieces = deep + sum(map(len, parts)) + sum(n * (1 + len(mesh)) for n, mesh in zip(visits, shown, strict=True))
        elements = sum(map(sum, parts)) + sum(n * sum(mesh) for n, mesh in zip(visits, shown, strict=True))
    except InputError as error:
        raise InputError(f"its header cannot be read: {error}") from None
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"it is damaged: its header cannot be read ({type(error).__name__})") from None
    if max(counts, default=0) > len(content):
        raise InputError(f"it is damaged: it announces {max(counts)} values, but has {len(content)} bytes")
    if min(counts, default=0) < 0:
        raise InputError("it is damaged: it announces fewer values than none")
    check_bytes(taken)
    check_elements(elements, "points and triangles")
    if pieces > _MOST_PIECES:
        raise InputError(
            f"its nodes and meshes, {len(nodes)} and {len(meshes)}, are too many or too deep: join them into one mesh"
        )


def _itemsize(accessor: dict[str, Any]) -> int:
    return _WIDTHS[accessor["type"]] * _SIZES[accessor["componentType"]]


def _elements(primitive: dict[str, Any], counts: list[int]) -> int:
    """Return how many points and triangles a part of a mesh has, attributes of points counted as points."""
    named: Iterable[int] = primitive["attributes"].values()
    return sum(counts[index] for index in named) + (counts[primitive["indices"]] // 3 if "indices" in primitive else 0)


def _visits(tree: dict[str, Any], nodes: list[dict[str, Any]]) -> tuple[list[int], int]:
    """Return how often each node is named as a root or a child, for the reader follows each of these ways once.

    And how many pieces it reads in the time that their depth takes it. Raises InputError for nodes that are deeper than
    anybody nests them, or within themselves.
    """
    visits, deep = [0] * len(nodes), 0
    scenes = tree.get("scenes", ())
    roots = scenes[tree.get("scene", 0)].get("nodes", ()) if scenes else ()
    for named in (roots, *(node.get("children", ()) for node in nodes)):
        for index in named:
            visits[index] += 1
    level = set(roots) if sum(visits) <= _MOST_PIECES else set()  # else they are too many anyway
    for depth in range(_DEEPEST):
        deep += len(level) * depth**3 // _CUBE
        level = {child for index in level for child in nodes[index].get("children", ())}
        if not level:
            return visits, deep
    raise InputError(f"its nodes are nested deeper than {_DEEPEST} levels")
