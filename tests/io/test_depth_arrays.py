"""Depth images from a driver, and poses in files: what they mean, and one sentence for what they cannot mean."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kmn_jax.errors import InputError
from kmn_jax.io import depth_array_scan, in_other_unit, pose_matrix, read_pose

K = np.array([[80.0, 0, 31.5], [0, 90.0, 23.5], [0, 0, 1]])
WHOLE = np.full((48, 64), 700, dtype=np.uint16)
WHOLE[0, :2] = 0, 65535  # not measured


@pytest.mark.parametrize("intrinsics", [K, K.ravel().tolist(), K.tolist(), (80, 90, 31.5, 23.5)])
def test_intrinsics_in_all_forms(intrinsics: Any) -> None:
    scan = depth_array_scan(WHOLE, intrinsics)
    assert scan.unit == "mm"
    assert scan.camera is not None
    np.testing.assert_array_equal(scan.camera.matrix, K)
    assert len(scan.points) == WHOLE.size - 2
    row, column = 5, 9
    place = [(column - 31.5) / 80 * 700, (row - 23.5) / 90 * 700, 700]
    np.testing.assert_allclose(scan.points[row * 64 + column - 2], place, rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "depth_unit", "unit", "stored"),
    [
        (WHOLE, None, "mm", 700),
        (WHOLE.astype(np.int32), "cm", "cm", 700),
        ((WHOLE / 1000).astype(np.float32), None, "m", 0.7),
        (WHOLE / 25.4, "in", "in", 700 / 25.4),
        (WHOLE * np.uint16(4), 0.00025, "m", 0.7),
        (WHOLE[..., None], None, "mm", 700),
    ],
)
def test_the_unit_is_that_of_ros_unless_it_is_given(
    values: np.ndarray, depth_unit: str | float | None, unit: str, stored: float
) -> None:
    scan = depth_array_scan(values, K, depth_unit)
    assert scan.unit == unit
    assert scan.depth is not None
    assert scan.depth[20, 30] == pytest.approx(stored, rel=1e-6)


@pytest.mark.parametrize(
    ("values", "intrinsics", "depth_unit", "message"),
    [
        (WHOLE.astype(np.uint8), K, None, r"shape \(48, 64\) and dtype uint8, but must be \(h, w\) of 16 bits"),
        (np.stack([WHOLE] * 3, axis=2), K, None, r"shape \(48, 64, 3\)"),
        (WHOLE, np.eye(2), None, r"K has shape \(2, 2\), but must be a matrix \(3, 3\), or fx, fy, cx and cy"),
        (WHOLE, "wide", None, "K has shape"),
        (WHOLE, K + np.eye(3)[[1, 0, 2]], None, "a camera with skew is not supported"),
        (WHOLE, (0, 90, 31.5, 23.5), None, "must be above zero"),
        (WHOLE, K, "ft", "unit 'ft' is not known"),
        (WHOLE, K, -0.001, "depth_scale = -0.001 must be above zero"),
        (np.zeros_like(WHOLE), K, None, "the depth image cannot be used: none of its 48 x 64 pixels was measured"),
    ],
)
def test_what_is_no_depth_image_is_one_sentence(
    values: np.ndarray, intrinsics: Any, depth_unit: str | float | None, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        depth_array_scan(values, intrinsics, depth_unit)


TURN = Rotation.from_euler("xyz", [20, -130, 75], degrees=True)
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = TURN.as_matrix(), (0.4, -0.2, 1.1)


@pytest.mark.parametrize(
    ("content", "unit"),
    [
        (POSE.tolist(), None),
        ({"T_base_camera": POSE.tolist(), "unit": "m"}, "m"),
        ({"xyz": [0.4, -0.2, 1.1], "xyzw": TURN.as_quat().tolist()}, None),
        ({"xyz": [0.4, -0.2, 1.1], "xyzw": (-1.005 * TURN.as_quat()).tolist(), "unit": "m"}, "m"),
    ],
)
def test_a_pose_is_read_in_all_forms(content: Any, unit: str | None, tmp_path: Path) -> None:
    (tmp_path / "pose.json").write_text(json.dumps(content))
    pose, stated = read_pose(tmp_path / "pose.json", "T_base_camera")
    assert stated == unit
    np.testing.assert_allclose(pose, POSE, atol=1e-12)
    np.testing.assert_allclose(in_other_unit(pose, "m", "mm")[:3, 3], [400, -200, 1100])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be used as a pose"),
        ("{}", r"has no T_base_camera \(4 x 4 numbers\), and no xyz with xyzw"),
        ('"a"', "no matrix of 4 x 4 numbers"),
        (json.dumps([[10**400] * 4] * 4), "no matrix of 4 x 4 numbers"),
        ('{"xyz": [1, 2, 1' + "0" * 400 + '], "xyzw": [0, 0, 0, 1]}', "xyz must be 3 finite numbers"),
        (json.dumps((2 * POSE).tolist()), "is not a rigid pose"),
        (json.dumps(POSE[:3].tolist()), r"has shape \(3, 4\)"),
        ('{"xyz": [1, 2, 3], "xyzw": [0, 0, 0, 2]}', "xyzw has the length 2, but must be a unit quaternion"),
        ('{"xyz": [1, 2, 3], "xyzw": [0, 0, 0, 1e200]}', "xyzw has the length inf"),
        ('{"xyz": [1, 2], "xyzw": [0, 0, 0, 1]}', "xyz must be 3 finite numbers"),
        (json.dumps({"T_base_camera": POSE.tolist(), "unit": "ft"}), "unit 'ft' is not known"),
        (
            json.dumps({"T_base_camera": POSE.tolist(), "units": "m"}),
            "it has 'units', which is not known: it may have T_base_camera, unit, xyz, xyzw",
        ),
        (json.dumps({"T_base_camera": POSE.tolist(), "xyz": [1, 2, 3]}), "both T_base_camera and xyz or xyzw"),
    ],
)
def test_what_is_no_pose_is_one_sentence(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "pose.json").write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_pose(tmp_path / "pose.json", "T_base_camera")
    assert "pose.json" in str(caught.value)
    with pytest.raises(InputError, match="cannot be read"):
        read_pose(tmp_path / "none.json", "T_base_camera")


def test_of_rounded_digits_the_nearest_rotation_is_taken() -> None:
    rounded = np.round(POSE, 3)
    assert np.abs(rounded[:3, :3].T @ rounded[:3, :3] - np.eye(3)).max() > 1e-4
    before = rounded.copy()
    rotation = pose_matrix(rounded, "T")[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, POSE[:3, :3], atol=1e-3)
    np.testing.assert_array_equal(rounded, before)  # the caller's own


def test_a_pose_keeps_its_digits() -> None:
    far = POSE.copy()
    far[0, 3] = 123456.789
    assert pose_matrix(far, "T").tolist() == far.tolist()
