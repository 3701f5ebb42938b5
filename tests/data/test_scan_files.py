"""Scans of every format against what was written, invalid values left out; damaged files are one sentence."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from kmn_jax.checks import InputError
from kmn_jax.data.scan_files import Scan, read_camera, read_scan

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(1, 2, (50, 3)).astype(np.float32)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)
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
        ("scan.npz", b"PK", "not a readable .npz file"),
        ("scan.png", b"\x89PNG", "not a readable image"),
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
    refused(np.zeros((0, 3)), "none of its 0 points was measured")
    np.save(path, np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="not a readable"):
        read_scan(path, "mm")
    np.savez(tmp_path / "scan.npz", other=np.zeros(3))
    with pytest.raises(InputError, match="neither points nor depth"):
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
        ('{"fx": "a", "fy": 1, "cx": 1, "cy": 1}', "cannot be used as a camera"),
    ],
)
def test_broken_cameras_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "camera.json").write_text(content)
    with pytest.raises(InputError, match=message):
        read_camera(tmp_path / "camera.json")


@settings(max_examples=150, deadline=None)
@given(data=st.data(), suffix=st.sampled_from([".npy", ".npz", ".xyz", ".ply", ".pcd", ".png"]))
def test_mutated_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, suffix: str
) -> None:
    folder = tmp_path_factory.mktemp("mutated")
    path = folder / f"scan{suffix}"
    if suffix == ".png":
        buffer = io.BytesIO()
        Image.fromarray(np.full((6, 8), 1000, np.uint16)).save(buffer, format="PNG")
        path.write_bytes(buffer.getvalue())
    else:
        write(path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(1, len(content)))
    path.write_bytes(bytes(content[:cut]))
    try:
        scan = read_scan(path, "mm", camera_file(folder))
    except InputError:
        return
    assert isinstance(scan, Scan)
    assert np.isfinite(scan.points).all()
    assert len(scan.points) > 0
