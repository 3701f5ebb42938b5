"""Valid files of every format that is read, small, and the same bytes whenever they are made."""

from __future__ import annotations

import io
import json
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from kmn_jax.models import KeyMatchNetConfig, create_model, save_model
from kmn_jax.models._released import save_released
from kmn_jax.objects import Part, Symmetries, save_part
from tests.attack.containers import zip_bytes, zip_members
from tests.io.mesh_sample import whole_files
from tests.reference.networks import TINY

CAMERA = json.dumps({"fx": 80.0, "fy": 82.0, "cx": 7.5, "cy": 5.5, "depth_scale": 0.1, "width": 16, "height": 12})
MATRIX = json.dumps({"cam_K": [80.0, 0.0, 7.5, 0.0, 82.0, 5.5, 0.0, 0.0, 1.0], "depth_scale": 1})
# The authors' structure in the smallest widths.
AUTHORS = KeyMatchNetConfig(
    normalization="released",
    pair_dropout="per_pair",
    edge_width=32,
    embedding_width=32,
    scene_width=32,
    object_width=32,
    pair_width=32,
)
_RANDOM = np.random.default_rng(0)
_DIRECTIONS = _RANDOM.normal(size=(100, 3))
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
_DENSE = _DIRECTIONS * (3 + _DIRECTIONS[:, :1]) * (3, 2, 1)  # without symmetries, whose search takes long
_POINTS = _RANDOM.uniform(1, 2, (80, 3)).astype(np.float32)
_DEPTH = _RANDOM.integers(1000, 2000, (12, 16)).astype(np.uint16)


@cache
def samples() -> dict[str, bytes]:
    """Return whole files by name: meshes, clouds, arrays and images."""
    with tempfile.TemporaryDirectory() as folder:
        return _samples(Path(folder))


def _samples(folder: Path) -> dict[str, bytes]:
    matrix = np.array([[80, 0, 7.5], [0, 82, 5.5], [0, 0, 1]])
    return {
        **whole_files(folder),
        "big.ply": _big_ply(),
        "mixed.ply": _mixed_ply(),
        "organised.npy": _npy(_POINTS.reshape(8, 10, 3)),
        "points.npy": _npy(_POINTS),
        "depth.npy": _npy(_DEPTH.astype(np.float32)),
        "points.npz": _npz(points=_POINTS.astype(np.float64), normals=_POINTS),
        "depth.npz": _npz(depth=_DEPTH, K=matrix),
        "depth.png": image_bytes("PNG"),
        "depth.tiff": image_bytes("TIFF"),
        "lzw.tif": image_bytes("TIFF", compression="tiff_lzw"),
        "deflate.tif": image_bytes("TIFF", compression="tiff_adobe_deflate"),
        "depth.exr": exr_bytes(folder, _DEPTH.astype(np.float32)),
        "dense.xyz": "\n".join(" ".join(map(str, row)) for row in _DENSE).encode(),
        "camera.json": CAMERA.encode(),
        "matrix.json": MATRIX.encode(),
    }


def image_bytes(kind: str, values: np.ndarray = _DEPTH, **options: object) -> bytes:
    """Return an image file."""
    file = io.BytesIO()
    Image.fromarray(values).save(file, kind, **options)
    return file.getvalue()


def exr_bytes(folder: Path, values: np.ndarray) -> bytes:
    """Return an EXR file of one channel."""
    import OpenEXR

    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"Z": values}).write(str(folder / "written.exr"))
    return (folder / "written.exr").read_bytes()


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _npz(**arrays: np.ndarray) -> bytes:
    return zip_bytes({f"{name}.npy": _npy(array) for name, array in arrays.items()}, packed=True)


def _big_ply() -> bytes:
    """A tetrahedron in big-endian bytes, of doubles."""
    header = ["ply", "format binary_big_endian 1.0", "element vertex 4"]
    header += [f"property double {name}" for name in "xyz"]
    header += ["element face 4", "property list uchar int vertex_indices", "end_header", ""]
    vertices = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]], ">f8").tobytes()
    faces = b"".join(b"\3" + np.array(row, ">i4").tobytes() for row in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)))
    return "\n".join(header).encode() + vertices + faces


def _mixed_ply() -> bytes:
    """A prism in little-endian bytes, of triangles and quads."""
    header = ["ply", "format binary_little_endian 1.0", "element vertex 6"]
    header += [f"property float {name}" for name in "xyz"]
    header += ["element face 5", "property list uchar int vertex_indices", "end_header", ""]
    corners = [[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9], [9, 0, 9], [0, 9, 9]]
    faces = ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))
    body = b"".join(bytes([len(row)]) + np.array(row, "<i4").tobytes() for row in faces)
    return "\n".join(header).encode() + np.array(corners, "<f4").tobytes() + body


def card(path: Path) -> None:
    """Write an object card."""
    directions = _DIRECTIONS.astype(np.float32)
    part = Part(
        name="ball",
        unit="mm",
        points=10 * directions,
        normals=directions,
        features=np.random.default_rng(1).normal(size=(8, 4)).astype(np.float32),
        diameter=20.0,
        minimum=np.full(3, -10.0),
        maximum=np.full(3, 10.0),
        area=1256.0,
        symmetries=Symmetries(np.eye(3)[None], np.array([[0.0, 0, 1]]), np.zeros(3), 0.02),
        source_digest="0" * 64,
        model_digest="1" * 64,
    )
    save_part(part, path)


def network(path: Path) -> None:
    """Write a model of the smallest widths."""
    import jax

    save_model(create_model(replace(TINY), jax.random.key(0)), path)


def authors_network(path: Path) -> None:
    """Write a model of the authors' names, a torch file or safetensors."""
    import jax

    save_released(create_model(AUTHORS, jax.random.key(0)), path)
    if path.suffix != ".safetensors":
        path.write_bytes(zip_bytes(zip_members(path.read_bytes()), packed=False))  # without the time of writing
