"""Scans of every format against what was written, invalid values left out; damaged files are one sentence."""

from __future__ import annotations

import io
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from kmn_jax.errors import InputError
from kmn_jax.io import _apart, _exr, read_scan
from kmn_jax.io._scans import read_camera

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(1, 2, (50, 3)).astype(np.float32)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)
PCD = b"VERSION 0.7\nFIELDS x y z\nSIZE " + b"9" * 3000 + b" 4 4\nTYPE F F F\nPOINTS 1\nDATA binary\n"
CAMERA = {"fx": 100.0, "fy": 110.0, "cx": 3.5, "cy": 2.5}


def camera_file(folder: Path, **changes: Any) -> Path:
    path = folder / "camera.json"
    path.write_text(json.dumps(CAMERA | changes))
    return path


def write(path: Path) -> Path:
    """Write the points, and where a format can hold them the normals."""
    if path.suffix == ".npy":
        np.save(path, np.concatenate([POINTS, NORMALS], axis=1))
    elif path.suffix == ".npz":
        np.savez(path, points=POINTS, normals=NORMALS)
    elif path.suffix in (".xyz", ".xyzn"):
        np.savetxt(path, np.concatenate([POINTS, NORMALS], axis=1))
    elif path.suffix == ".ply":
        header = "ply\nformat binary_little_endian 1.0\nelement vertex 50\n"
        names = ("x", "y", "z", "nx", "ny", "nz")
        header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
        path.write_bytes(header.encode() + np.concatenate([POINTS, NORMALS], axis=1).tobytes())
    else:
        header = "VERSION 0.7\nFIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\n"
        header += "COUNT 1 1 1 1 1 1\nWIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA binary\n"
        path.write_bytes(header.encode() + np.concatenate([POINTS, NORMALS], axis=1).tobytes())
    return path


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".xyz", ".xyzn", ".ply", ".pcd"])
def test_clouds_of_every_format(tmp_path: Path, suffix: str) -> None:
    scan = read_scan(write(tmp_path / f"scan{suffix}"), "mm")
    np.testing.assert_allclose(scan.points, POINTS, rtol=1e-6)
    if suffix == ".xyz":
        assert scan.normals is None
    else:
        np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-6)
    assert (scan.depth, scan.camera, scan.unit) == (None, None, "mm")


def test_organised_clouds_lose_what_was_not_measured(tmp_path: Path) -> None:
    grid = POINTS[:48].reshape(6, 8, 3).copy()
    grid[0, 0], grid[1, 2], grid[3, 3, 1] = 0, np.nan, np.inf
    np.save(tmp_path / "scan.npy", grid)
    scan = read_scan(tmp_path / "scan.npy", "m")
    kept = np.ones((6, 8), dtype=bool)
    kept[0, 0] = kept[1, 2] = kept[3, 3] = False
    np.testing.assert_array_equal(scan.points, grid[kept])


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".npz"])
def test_depth_images_become_points_by_the_camera(tmp_path: Path, suffix: str) -> None:
    stored = RNG.integers(1000, 2000, (6, 8)).astype(np.uint16)
    stored[0, 0], stored[5, 7] = 0, 65535
    path = tmp_path / f"depth{suffix}"
    if suffix == ".npy":
        np.save(path, stored)
    elif suffix == ".npz":
        np.savez(path, depth=stored)
    else:
        Image.fromarray(stored).save(path)
    scan = read_scan(path, "mm", camera_file(tmp_path, depth_scale=0.1, width=8, height=6))
    assert scan.depth is not None
    assert scan.camera is not None
    assert len(scan.points) == 46
    z = stored[2, 5] * 0.1
    row = np.flatnonzero(np.isclose(scan.points[:, 2], z))
    wanted = [(5 - 3.5) / 100 * z, (2 - 2.5) / 110 * z, z]
    assert np.isclose(scan.points[row], wanted, rtol=1e-5).all(axis=1).any()
    assert scan.depth[0, 0] == scan.depth[5, 7] == 0
    assert scan.camera.matrix[1, 1] == 110
    metres = scan.in_unit("m")
    np.testing.assert_allclose(metres.points, scan.points / 1000, rtol=1e-6)
    np.testing.assert_allclose(metres.depth, scan.depth / 1000, rtol=1e-6)


def test_intrinsics_may_be_in_the_file_or_a_matrix(tmp_path: Path) -> None:
    depth = np.full((6, 8), 1.5, dtype=np.float32)
    matrix = np.array([[100, 0, 3.5], [0, 110, 2.5], [0, 0, 1]])
    np.savez(tmp_path / "scan.npz", depth=depth, K=matrix)
    one = read_scan(tmp_path / "scan.npz", "m")
    np.save(tmp_path / "scan.npy", depth)
    (tmp_path / "bop.json").write_text(json.dumps({"cam_K": matrix.ravel().tolist()}))
    other = read_scan(tmp_path / "scan.npy", "m", tmp_path / "bop.json")
    np.testing.assert_array_equal(one.points, other.points)
    assert one.camera == other.camera


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("scan.dat", b"1 2 3", "the format .dat is not known for scans"),
        ("scan.xyz", b"", "is empty"),
        ("scan.xyz", b"0 0 0\nnan nan nan\n", "none of its 2 points was measured"),
        ("scan.ply", b"solid", "cannot be used"),
        ("scan.npy", b"\x93NUMPY", "not a readable .npy file"),
        pytest.param("scan.pcd", PCD, r"data type '<f9{99,111}\.\.\.\)$", id="long word"),
        pytest.param(
            "scan.npy",
            b"\x93NUMPY\1\0\x30\x75" + b" " * 30_000,
            r"^[^\n]*is not a readable .npy file[^\n]*large[^\n]*\Z",
            id="words of two lines",
        ),
        ("scan.npz", b"PK", "not a readable .npz file"),
        ("scan.png", b"\x89PNG", "not a readable image"),
        ("scan.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "not a readable image"),
        ("scan.exr", b"\x89PNG", "is not an EXR file"),
        ("scan.exr", b"\x76\x2f\x31\x01" + bytes(100), "truncated or damaged"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_scan(tmp_path / name, "mm", camera_file(tmp_path))


def test_wrong_arrays_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.npy"

    def refused(array: np.ndarray, message: str) -> None:
        np.save(path, array)
        with pytest.raises(InputError, match=message):
            read_scan(path, "mm", camera_file(tmp_path))

    refused(np.array(["a"]), "does not hold numbers")
    refused(np.zeros((4, 5, 2)), "its points have shape")
    refused(np.zeros((4, 5)), "none of its 4 x 5 pixels was measured")
    refused(np.zeros((0, 3)), r"it holds nothing: its shape is \(0, 3\)")
    np.save(path, np.ones((50, 4)))
    with pytest.raises(InputError, match=r"its points have shape \(50, 4\)"):
        read_scan(path, "mm")
    np.save(path, np.ones((20_000, 16)))
    with pytest.raises(InputError, match="it is a depth image, which needs a camera file"):
        read_scan(path, "mm")
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (2**70, 0, 3)})
    with pytest.raises(InputError, match="it is damaged, its shape is"):
        read_scan(path, "mm")
    refused(np.array([{}], dtype=object), "does not hold numbers, but object values")
    np.savez(tmp_path / "scan.npz", other=np.zeros(3))
    with pytest.raises(InputError, match="it holds other, but neither points nor depth"):
        read_scan(tmp_path / "scan.npz", "mm")
    np.savez(tmp_path / "scan.npz", points=POINTS, normals=np.ones((len(POINTS), 1)))
    with pytest.raises(InputError, match="its normals have shape"):
        read_scan(tmp_path / "scan.npz", "mm")


def test_pictures_and_missing_cameras_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "colour.png")
    with pytest.raises(InputError, match="depth has one channel of 16 bits"):
        read_scan(tmp_path / "colour.png", "mm", camera_file(tmp_path))
    Image.fromarray(np.ones((4, 4), np.uint16)).save(tmp_path / "depth.png")
    with pytest.raises(InputError, match="needs a camera file"):
        read_scan(tmp_path / "depth.png", "mm")
    with pytest.raises(InputError, match="4 x 4 pixels, but its camera 8 x 6"):
        read_scan(tmp_path / "depth.png", "mm", camera_file(tmp_path, width=8, height=6))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "no JSON object"),
        ("{", "cannot be used as a camera"),
        ('{"fx": 1}', "it has no 'fy'"),
        ('{"fx": 0, "fy": 1, "cx": 1, "cy": 1}', "must be above zero"),
        ('{"fx": 1, "fy": 1, "cx": NaN, "cy": 1}', "all finite"),
        ('{"cam_K": [1, 2]}', "2 numbers instead of 9"),
        ('{"cam_K": [9, 1, 4, 0, 9, 3, 0, 0, 1]}', "a camera with skew is not supported"),
        ('{"cam_K": [9, 0, 0, 0, 9, 0, 4, 3, 1]}', "row by row"),
        ('{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": 1e999}', "all finite"),
        ('{"fx": "a", "fy": 1, "cx": 1, "cy": 1}', "cannot be used as a camera"),
        pytest.param(json.dumps({"cam_K": ["a" * 5000] * 9}), r"a\.\.\.$", id="long"),
    ],
)
def test_broken_cameras_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "camera.json").write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_camera(tmp_path / "camera.json")
    assert str(caught.value).startswith(f"{tmp_path / 'camera.json'} cannot be used")
    assert len(str(caught.value)) < len(str(tmp_path)) + 300


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.float16, np.uint16, np.int32])
def test_what_was_not_measured_is_left_out(tmp_path: Path, dtype: type) -> None:
    depth = np.full((4, 5), 700, dtype=dtype)
    depth[0, 0] = 0
    if dtype is np.int32:
        depth[0, 1], depth[0, 2], depth[1, 0] = -1, 65535, np.iinfo(np.int32).max
    elif dtype is np.uint16:
        depth[0, 1], depth[0, 2], depth[1, 0] = 65535, 0, 65535
    else:
        depth[0, 1], depth[0, 2], depth[1, 0] = -1, np.nan, np.inf
        depth[1, 1] = 65504 if dtype is np.float16 else 1e10  # the background of renderers
    np.save(tmp_path / "depth.npy", depth)
    scan = read_scan(tmp_path / "depth.npy", "mm", camera_file(tmp_path))
    assert scan.depth is not None
    np.testing.assert_array_equal(scan.depth, np.where(depth == 700, 700, 0))
    assert len(scan.points) == (depth == 700).sum()
    np.testing.assert_array_equal(scan.points[:, 2], 700)


def test_far_points_are_left_out(tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", np.array([[1.0, 2, 3], [0, 0, 1e10], [1e300, 0, 1], [-1e9, 0, 1]]))
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.npy", "mm").points, [[1, 2, 3]])


@pytest.mark.parametrize("changes", [{"depth_scale": 1e30}, {"depth_scale": 1e-60}, {"fx": 1e-300}])
def test_absurd_cameras_are_refused(tmp_path: Path, changes: dict[str, float]) -> None:
    np.save(tmp_path / "depth.npy", np.full((4, 5), 700.0))
    with pytest.raises(InputError, match="check depth_scale, fx, fy and unit"):
        read_scan(tmp_path / "depth.npy", "mm", camera_file(tmp_path, **changes))


def test_points_are_taken_where_depth_has_no_camera(tmp_path: Path) -> None:
    np.savez(tmp_path / "scan.npz", points=POINTS, depth=np.full((6, 8), 1.5))
    assert read_scan(tmp_path / "scan.npz", "m").depth is None
    assert read_scan(tmp_path / "scan.npz", "m", camera_file(tmp_path)).depth is not None
    np.savez(tmp_path / "skew.npz", depth=np.full((6, 8), 1.5), K=np.ones((3, 3)))
    with pytest.raises(InputError, match="K must be fx 0 cx 0 fy cy 0 0 1"):
        read_scan(tmp_path / "skew.npz", "m")


DEPTH = RNG.uniform(0.5, 1.5, (6, 8)).astype(np.float32)


def exr(path: Path, channels: dict[str, np.ndarray], **header: Any) -> Path:
    import OpenEXR

    OpenEXR.File({"type": OpenEXR.scanlineimage} | header, channels).write(str(path))
    return path


@pytest.mark.parametrize(
    ("name", "dtype"), [("Z", np.float32), ("Y", np.float16), ("R", np.float32), ("depth", np.float32)]
)
def test_exr_depth_of_one_channel(tmp_path: Path, name: str, dtype: type) -> None:
    stored = DEPTH.astype(dtype)
    stored[0, :5] = 0, -1, np.nan, np.inf, (65504 if dtype is np.float16 else 1e10)
    scan = read_scan(exr(tmp_path / "depth.exr", {name: stored}), "m", camera_file(tmp_path, width=8, height=6))
    assert scan.depth is not None
    wanted = stored.astype(np.float32)
    wanted[0, :5] = 0
    np.testing.assert_array_equal(scan.depth, wanted)
    assert len(scan.points) == 43


def test_exr_depth_beside_colour(tmp_path: Path) -> None:
    colour = np.full((6, 8, 3), 0.5, np.float32)
    layers = exr(tmp_path / "layers.exr", {"RGB": colour, "View.Depth": DEPTH})
    np.testing.assert_array_equal(read_scan(layers, "m", camera_file(tmp_path)).depth, DEPTH)
    two = {"A": DEPTH, "B": DEPTH}
    for name, channels in {"colour": {"RGB": colour}, "two": two, "depths": {"Z": DEPTH, "depth": DEPTH}}.items():
        with pytest.raises(InputError, match=r"its channels are .*: save the depth alone, or as one channel called Z"):
            read_scan(exr(tmp_path / f"{name}.exr", channels), "m", camera_file(tmp_path))


def test_exr_of_a_part_of_the_image(tmp_path: Path) -> None:
    """The camera's centre counts from the corner of the display window."""
    window = (np.array([2, 1], np.int32), np.array([9, 6], np.int32))
    whole = (np.array([0, 0], np.int32), np.array([8, 9], np.int32))
    path = exr(tmp_path / "crop.exr", {"Z": DEPTH}, dataWindow=window, displayWindow=whole)
    wanted = np.zeros((10, 9), np.float32)
    wanted[1:7, 2:9] = DEPTH[:, :7]
    np.testing.assert_array_equal(read_scan(path, "m", camera_file(tmp_path, width=9, height=10)).depth, wanted)


@pytest.mark.parametrize("kind", ["ZIP", "PIZ", "RLE", "NO", "ZIPS"])
def test_truncated_exr_files_are_refused(tmp_path: Path, kind: str) -> None:
    import OpenEXR

    large = RNG.uniform(0.5, 1.5, (48, 64)).astype(np.float32)
    path = exr(tmp_path / "depth.exr", {"Z": large}, compression=getattr(OpenEXR, f"{kind}_COMPRESSION"))
    content = path.read_bytes()
    for cut in (3, 200, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:cut])
        with pytest.raises(InputError, match=r"is not an EXR file|truncated or damaged"):
            read_scan(path, "m", camera_file(tmp_path))


def test_announced_sizes_take_no_memory(tmp_path: Path) -> None:
    """What a header announces is compared with the size of the file before anything is allocated."""

    def refused(path: Path, message: str) -> None:
        with pytest.raises(InputError, match=message):
            read_scan(path, "mm", camera_file(tmp_path))

    content = exr(tmp_path / "depth.exr", {"Z": DEPTH}).read_bytes()
    window = np.array([0, 0, 7, 5], "<i4").tobytes()
    huge = np.array([0, 0, 6999, 6999], "<i4").tobytes()
    (tmp_path / "depth.exr").write_bytes(content.replace(window, huge))
    refused(tmp_path / "depth.exr", "announces more than")
    np.save(tmp_path / "scan.npy", POINTS)
    content = (tmp_path / "scan.npy").read_bytes()
    (tmp_path / "scan.npy").write_bytes(content.replace(b"(50, 3), }      ", b"(50000000, 3), }"))
    refused(tmp_path / "scan.npy", "not a readable .npy file")
    buffer = io.BytesIO()
    Image.fromarray(np.ones((6, 8), np.uint16)).save(buffer, format="PNG")
    content = bytearray(buffer.getvalue())
    content[16:24] = (7000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    (tmp_path / "depth.png").write_bytes(content)
    refused(tmp_path / "depth.png", "it announces 49000000 pixels")


def test_a_decoder_that_crashes_or_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = exr(tmp_path / "depth.exr", {"Z": DEPTH})
    monkeypatch.setattr(_exr, "_PROGRAM", "import os; os.abort()")
    with pytest.raises(InputError, match="the decoder ended with code"):
        read_scan(path, "m", camera_file(tmp_path))
    monkeypatch.setattr(_apart.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"need packages that are not installed: pip install .*openexr"):
        read_scan(path, "m", camera_file(tmp_path))
